"""Shapes of the stand-in cell's toys, made from formulas: NumPy only, the same on every machine."""
