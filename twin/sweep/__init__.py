"""Depth of posed colour images from each other, where none was recorded."""
