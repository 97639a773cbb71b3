"""The only door to the log: live data goes in, episodes come out."""
