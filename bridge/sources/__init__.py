"""Who speaks on the wire: an RGB-D folder and the stand-in cell."""
