"""How long runs must be for every arm to reach the same number of Gaussians.

Strategy ``grow`` adds at most ``FASTEST`` of what there is in a round, and a short run has few
rounds: from few points it would end below the budget, and arms of unequal numbers say nothing.
"""

from __future__ import annotations

import math
from itertools import count

from splatseed.train.schedule import FULL_RUN, make_schedule


def growth_within(steps: int) -> float:
    """The factor by which ``grow`` is sure to multiply its Gaussians in a run of so many steps."""
    from splatseed.train.growing import FASTEST  # noqa: PLC0415  (imports PyTorch)

    schedule = make_schedule("grow", steps, as_3dgs=False)
    rounds = schedule.refine_stop // schedule.refine_every
    # One round makes up for the Gaussians that are removed.
    return float((1 + FASTEST) ** max(0, rounds - 1))


def most_grown(num_points: int, steps: int) -> int:
    """The most Gaussians that ``grow`` is sure to reach from so many points in so many steps."""
    return max(2, math.floor(num_points * growth_within(steps)))


def steps_to_grow(factor: float) -> int:
    """The fewest steps in which ``grow`` multiplies its Gaussians by a factor.

    Args:
        factor: At most what a full run reaches; a larger one counts as that.
    """
    within = min(factor, growth_within(FULL_RUN))
    return next(steps for steps in count(10, 10) if growth_within(steps) >= within)
