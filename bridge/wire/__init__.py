"""Zenoh sessions, keys and encodings; the only room that imports zenoh."""
