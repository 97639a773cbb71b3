"""Follow the log or let physics answer; the acceptance indicator; writes an episode."""
