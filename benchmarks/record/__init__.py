"""The recorder's benchmark: a cell that knows what it sent, recorders, faults, and one table."""
