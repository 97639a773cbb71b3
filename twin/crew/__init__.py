"""Processes that do pieces of work, and may die without harm."""
