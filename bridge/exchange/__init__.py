"""Other people's formats in: RGB-D folders, CSV trials."""
