"""How long training takes: a rough model of a step, calibrated by the run's own first steps.

Notation: a step takes a + b G + c P seconds for G Gaussians and P pixels of a photograph. Promise:
the estimate includes the growth of G.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

from splatseed.training.settings import TrainSettings

COSTS = {"cpu": (5e-3, 0.35e-6, 0.15e-6), "cuda": (8e-3, 5e-9, 2e-9)}
"""a, b and c. On the CPU: of 2 cores, between a quiet machine with AVX-512 and a busy machine with
AVX2, on nine captures; with CUDA: of one GPU with 3 million Gaussians. Another machine may be twice
as fast or half as fast; the proportions of a, b and c differ less."""
MEASURED_THREADS = 2
"""Threads with which the CPU's costs were measured; more threads divide the time of a step."""
GAUSSIANS_PER_SEED = 3.0
"""Gaussians at the end of a run per seed, with densification and without a cap: a guess."""
HOUR, TOO_LONG = 3600.0, 5400.0
"""Seconds of a suggested run, and seconds above which a shorter run is suggested."""
_ROUNDING = 1e-6
MIN_SIDE = 400
"""Longer side, px, down to which smaller photographs are suggested before fewer steps."""
FEWER_STEPS, STEP_UNIT = 7000, 100
"""Steps to suggest after that; if they still take too long, a smaller multiple of the unit."""


def step_seconds(device: str, gaussians: float, pixels: float) -> float:
    """Return the model's seconds of a step on ``cpu`` or ``cuda``."""
    a, b, c = COSTS[device]
    return a + b * gaussians + c * pixels


class RunSpeed(NamedTuple):
    """The position of a run, and its speed."""

    step: int  # steps done
    seconds: float  # per step, now
    gaussians: int
    pixels: int  # of a photograph as it is trained
    device: str = "cpu"  # or cuda


def mean_gaussians(settings: TrainSettings, now: RunSpeed) -> float:
    """Return the mean number of Gaussians over the remaining steps.

    The number grows linearly until densification ends. Strategies with a default budget fill the
    cap; others reach ``GAUSSIANS_PER_SEED`` times the seeds, or the cap if it is lower.
    """
    strategy, count, left = settings.traits, now.gaussians, settings.max_steps - now.step
    full = strategy.full_at
    stop = settings.schedule.refine_stop if full is None else full * settings.max_steps
    stop = min(stop, settings.max_steps)
    if not strategy.number_grows or now.step >= stop:
        return count
    if strategy.has_default_budget:
        last = float(settings.cap or count)
    else:
        last = min(count * GAUSSIANS_PER_SEED ** (1 - now.step / stop), settings.cap or math.inf)
    rising = (stop - now.step) / left
    return count + max(0.0, last - count) * (1 - rising / 2)


def seconds_left(settings: TrainSettings, now: RunSpeed) -> float:
    """Return the seconds until the last step."""
    left = settings.max_steps - now.step
    if left <= 0:
        return 0.0
    slower = now.seconds / step_seconds(now.device, now.gaussians, now.pixels)
    return left * slower * step_seconds(now.device, mean_gaussians(settings, now), now.pixels)


def planned_seconds(settings: TrainSettings, seeds: int, pixels: int, threads: int) -> float:
    """Estimate the seconds of all steps of a run on the CPU.

    Args:
        settings: The run's.
        seeds: Number of points that it starts from.
        pixels: Of a photograph as it is trained.
        threads: Cores that it uses.
    """
    step = MEASURED_THREADS / threads * step_seconds("cpu", seeds, pixels)
    return seconds_left(settings, RunSpeed(0, step, seeds, pixels))


def options_for_an_hour(
    settings: TrainSettings, now: RunSpeed, long_side: int, *, per_pixel: bool
) -> str:
    """Return options with which the run would take at most about an hour on this machine.

    Args:
        settings: The run's.
        now: Its position and speed.
        long_side: Longer side of the photographs as they are stored.
        per_pixel: Whether the budget follows the pixels of the photographs.
    """
    slower = now.seconds / step_seconds(now.device, now.gaussians, now.pixels)
    smaller_ones = range(math.floor(settings.factor) + 1, long_side // MIN_SIDE + 1)
    factors = (settings.factor, *smaller_ones)
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
        needed = seconds_left(planned, RunSpeed(0, seconds, count, pixels, now.device))
        if needed <= HOUR:
            break
    else:  # the budget alone takes longer
        steps = max(STEP_UNIT, int(steps * HOUR / needed) // STEP_UNIT * STEP_UNIT)
    flags = f"`long_side={math.ceil(long_side / factor - _ROUNDING)}`"
    return flags if steps == settings.max_steps else f"{flags} `max_steps={steps}`"
