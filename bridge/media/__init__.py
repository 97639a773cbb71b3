"""Colour and depth codecs."""
