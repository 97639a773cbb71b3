"""RGB-D folders in three layouts, as the messages of a live camera."""
