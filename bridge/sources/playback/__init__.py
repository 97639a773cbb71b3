"""Plays an episode back onto zenoh, with its own timing."""
