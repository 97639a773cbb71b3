"""Training frames read once: points and views, what moved, whether the scan makes sense."""
