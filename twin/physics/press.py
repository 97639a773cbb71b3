"""Fingers that press on what does not yield get their force in fewer iterations of the solver.

The solver begins each step with fingers that press by nothing, and each of its iterations adds what
stops a finger at the speed it is driven with. At the usual speed 20 N take 45 iterations; all else
takes 10. Fingers that stand still although they are told to close are therefore driven faster.
Their force is the same. What they hold may give way: then they are at the usual speed again before
they have gone far. docs/decisions/0049-stalled-fingers.md.
"""

from twin.physics.arm import Arm

PRESS_M_S = 0.8
"""Speed with which stalled fingers are driven; until somebody looks they go 7 mm at most."""
STALLED_M_S = 0.02
"""Fingers slower than this are stopped by something."""
SHORT_M = 0.0005
"""Fingers this near to where they were told to be have arrived there."""
EVERY_STEPS = 2
"""How often fingers are asked."""
PATIENCE = 2
"""So many times they must have been found to be stopped."""


class Press:
    """Watches the fingers of an arm."""

    def __init__(self, arm: Arm) -> None:
        """Start with fingers at their usual speed.

        Args:
            arm: Whose fingers.
        """
        self._arm = arm
        self._steps = 0
        self._found = 0

    def update(self, *, anew: bool) -> None:
        """Drive the fingers for the next step. Call once per step.

        Args:
            anew: Contacts begin anew: fingers may find less in their way than there is.
        """
        self._steps += 1
        if anew:
            self._found = 0
            self._arm.press(None)
        elif self._arm.closing and self._steps % EVERY_STEPS == 0:
            self._found = self._found + 1 if self._stalled() else 0
            self._arm.press(PRESS_M_S if self._found >= PATIENCE else None)
        elif not self._arm.closing:
            self._found = 0

    def _stalled(self) -> bool:
        return all(
            short_m > SHORT_M and abs(speed_m_s) < STALLED_M_S
            for short_m, speed_m_s in self._arm.fingers()
        )
