"""Processes that share the work, on one machine or on many."""
