"""When points count as a soft toy, and when two toys count as told apart."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class SoftConfig:
    """How soft toys are found."""

    min_height_m: float = 0.006
    """Lower points may be table."""
    clear_m: float = 0.009
    """Points nearer than this to a rigid object that was found belong to it."""
    growth: float = 1.2
    """A cluster with a longer diagonal than the toy's times this holds more than one thing."""
    shrink: float = 0.35
    """One shorter than the toy's shortest extent times this is not the toy."""
    fill: float = 0.7
    """A toy covers this share of the rectangle around it, seen from above."""
    stretch_m: float = 0.012
    """Points nearer than this to the fitted surface show how the toy is deformed."""
    tilt_sigma_rad: float = 0.1
    """Prior of roll and pitch of a toy that stands."""
    well_explained: float = 0.9
    """With less it may lie on another side: more starts are tried."""
    well_seen_through: float = 0.12
    """So they are with more of its surface seen through."""
    hopeless: float = 0.5
    """With less it is no such toy on any side: one on a wrong side explains two thirds."""
    turned_share: float = 0.1
    """Clusters with fewer points than this share of the largest show too little of a toy to tell
    its sides apart."""
    max_seen_through: float = 0.3
    """With more of its surface seen through it is something else."""
    min_agreeing: float = 0.35
    """Some camera must measure this share of the surface that faces it where the toy is."""
    moved_m: float = 0.05
    """Equal toys farther from where they are expected were moved, no matter how far: those that
    stayed keep their names."""
    score_m: float = 0.2
    """In the assignment, a point of score counts like this distance."""
    min_margin_m: float = 0.02
    """Equal toys whose exchange would cost less are reported as hardly told apart."""
