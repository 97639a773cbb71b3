"""Colour, depth and video codecs, and how much one image is like another."""
