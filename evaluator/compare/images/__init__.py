"""Rendered against recorded images: pairs, scores, tables, and methods side by side."""
