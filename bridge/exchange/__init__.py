"""Other people's formats in: RGB-D folders, Kinova reality-gap runs, CSV trials."""
