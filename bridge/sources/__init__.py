"""Publish sensor and robot data over zenoh: RGB-D folders, cameras, arms, the stand-in cell."""
