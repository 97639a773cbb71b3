"""How long one stage of a fit may take, so that the budget holds however many views there are."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Allowance:
    """Time until which a stage may run, by the clock of the fit."""

    clock: Callable[[], float] = time.monotonic
    until_s: float = math.inf
    """On that clock; infinite when images are counted instead of time."""

    def left_s(self) -> float:
        """Seconds that are left; negative when it is over."""
        return self.until_s - self.clock()

    def is_over(self) -> bool:
        """Say whether nothing more should be begun."""
        return self.left_s() <= 0


UNLIMITED = Allowance()
