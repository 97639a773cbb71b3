"""Objects as parts of a scene that can be moved."""
