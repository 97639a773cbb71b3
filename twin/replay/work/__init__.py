"""One replay as a piece of work: what decides it, doing it, comparing it."""
