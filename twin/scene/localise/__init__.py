"""Where known objects are, from RGB-D frames, episodes and live cells."""
