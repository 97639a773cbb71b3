"""One trajectory replayed and judged: I(tau)."""
