"""Varied replays: success as a probability."""
