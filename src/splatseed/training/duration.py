"""How long training takes: a rough model of a step, which a run's own first steps calibrate.

Notation: a step takes a + b G + c P seconds for G Gaussians and P pixels of a photograph. Promise:
later steps are slower because there are more Gaussians, and that is counted.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from splatseed.training.schedule import FULL_AT
from splatseed.training.settings import TrainSettings

COSTS = {"cpu": (6e-3, 0.18e-6, 0.09e-6), "cuda": (8e-3, 5e-9, 2e-9)}
"""a, b and c: measured on 2 cores with AVX-512 on three scenes, and on one GPU with 3 million
Gaussians. Another machine may be several times off, its proportions less."""
GROWTH = 3.0
"""Gaussians at the end of a run per seed, with densification and without a cap: a guess."""
HOUR, TOO_LONG = 3600.0, 5400.0
"""Seconds of the run that is advised, and of a run beyond which that is."""
LEAST_SIDE = 400
"""Longer side down to which smaller photographs are advised, before fewer steps."""
FEWER_STEPS, STEPS_OF = 7000, 100
"""Steps that are advised then; if these take long, too, fewer hundreds."""


def step_seconds(device: str, gaussians: float, pixels: float) -> float:
    """Seconds of a step on ``cpu`` or ``cuda``, by the model alone."""
    a, b, c = COSTS[device]
    return a + b * gaussians + c * pixels


class Progressed(NamedTuple):
    """How far a run is, and how fast."""

    step: int  # steps done
    seconds: float  # that a step takes now
    gaussians: int
    pixels: int  # of a photograph as it is trained
    device: str = "cpu"  # or cuda


def mean_gaussians(settings: TrainSettings, now: Progressed) -> float:
    """The mean number of Gaussians over the steps that are left.

    It rises linearly until growth ends, and stays: the budget is spent then, if there is one.
    """
    growth, count, left = settings.densification, now.gaussians, settings.max_steps - now.step
    stop = FULL_AT * settings.max_steps if growth == "grow" else settings.schedule.refine_stop
    stop = min(stop, settings.max_steps)
    if growth == "none" or now.step >= stop:
        return count
    if growth in ("grow", "mcmc"):
        last = float(settings.cap or count)
    else:
        last = min(count * GROWTH ** (1 - now.step / stop), settings.cap or math.inf)
    rising = (stop - now.step) / left
    return count + max(0.0, last - count) * (1 - rising / 2)


def seconds_left(settings: TrainSettings, now: Progressed) -> float:
    """Seconds until the last step."""
    left = settings.max_steps - now.step
    if left <= 0:
        return 0.0
    slower = now.seconds / step_seconds(now.device, now.gaussians, now.pixels)
    return left * slower * step_seconds(now.device, mean_gaussians(settings, now), now.pixels)


def about_an_hour(
    settings: TrainSettings, now: Progressed, long_side: int, *, per_pixel: bool
) -> str:
    """The options with which the whole run would take about an hour at most on this machine.

    Args:
        settings: The run's.
        now: How far it is.
        long_side: Longer side of the photographs as they are stored.
        per_pixel: Whether the budget follows the pixels of the photographs.
    """
    slower = now.seconds / step_seconds(now.device, now.gaussians, now.pixels)
    factors = range(settings.factor, max(settings.factor, long_side // LEAST_SIDE) + 1)
    fewer = min(FEWER_STEPS, settings.max_steps)
    tried = [(steps, factor) for steps in (settings.max_steps, fewer) for factor in factors]
    for steps, factor in tried:
        smaller = (settings.factor / factor) ** 2
        cap, pixels = settings.cap_max, round(now.pixels * smaller)
        if cap is not None and per_pixel:
            cap = max(2, round(cap * smaller))
        count = min(now.gaussians, cap or now.gaussians)
        planned = replace(settings, max_steps=steps, cap_max=cap)
        seconds = slower * step_seconds(now.device, count, pixels)
        needed = seconds_left(planned, Progressed(0, seconds, count, pixels, now.device))
        if needed <= HOUR:
            break
    else:  # the budget alone takes longer
        steps = max(STEPS_OF, int(steps * HOUR / needed) // STEPS_OF * STEPS_OF)
    flags = f"--long-side {math.ceil(long_side / factor)}"
    return flags if steps == settings.max_steps else f"{flags} --max-steps {steps}"


def in_words(seconds: float) -> str:
    """A duration, as people say it.

    Example:
        >>> in_words(100), in_words(3000), in_words(19_000), in_words(200_000)
        ('2 minutes', '50 minutes', '5 hours', '56 hours')
    """
    if seconds < HOUR * 1.5:
        minutes = max(1, round(seconds / 60))
        return f"{minutes} minute{'s' if minutes > 1 else ''}"
    return f"{math.floor(seconds / HOUR + 0.5)} hours"
