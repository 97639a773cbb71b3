"""Colour and depth codecs, and how much one image is like another."""
