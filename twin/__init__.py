"""Rebuilds the place and re-lives the episode."""
