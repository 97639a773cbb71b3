"""Read a run folder: which episodes it has, and what each says of itself."""
