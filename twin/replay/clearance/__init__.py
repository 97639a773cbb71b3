"""The clearance delta(x_t) of I(tau): who comes too close to what (errata resolution 8)."""
