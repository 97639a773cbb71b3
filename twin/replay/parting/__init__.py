"""Planned, executed and recorded laid over each other: where they part first."""
