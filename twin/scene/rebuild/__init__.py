"""Episodes in, scene out."""
