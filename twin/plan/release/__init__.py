"""Final states by sampling, Eq. 8 and 9: where a carried object may be let go."""
