"""Zenoh sessions, keys and encodings; the only package that imports zenoh."""
