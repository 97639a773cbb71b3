"""Who came close to whom, and when: what clearance and the contact predicate speak of."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Contact:
    """One stretch of time in which two bodies were closer than the margin."""

    start_ns: int
    """From the start of the trajectory."""
    end_ns: int
    bodies: tuple[str, str]
    allowed: bool
    """Whether the active stage allowed them to touch."""
    min_distance_m: float
    """Smallest signed distance; negative where they overlapped."""
