"""A replay as an episode: its messages and its pictures."""
