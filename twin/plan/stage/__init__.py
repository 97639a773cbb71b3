"""Stage optimisation, Eq. 7: where the tool may be at the end of a stage, and how open."""
