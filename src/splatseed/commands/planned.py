"""How a scene will be trained, as far as advice on its seeds depends on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatseed.scene import Scene
from splatseed.train.schedule import FULL_RUN
from splatseed.train.seeds import most_seeds
from splatseed.train.settings import BUDGET, TrainSettings


@dataclass(frozen=True)
class Planned:
    """How a scene will be trained.

    Args:
        budget: Most Gaussians at the end.
        max_steps: Training steps.
        strategy: The strategy that ``splatseed train`` chooses for these steps.
        most_seeds: Most seeds with which training begins.
        flags: The options of ``splatseed train`` that differ from its defaults.
        tuning: Those of ``splatseed tune`` that plan the same.
    """

    budget: int
    max_steps: int
    strategy: str
    most_seeds: int
    flags: str = ""
    tuning: str = ""

    @classmethod
    def of(cls, scene: Scene, budget: str | None, max_steps: int) -> Planned:
        """A scene's plan, from the options.

        Raises:
            ParameterError: One of them is out of its range.
        """
        sizes = [image.intrinsics.width * image.intrinsics.height for image in scene.images]
        pixels = round(float(np.median(sizes))) if sizes else BUDGET
        number = max(2, min(BUDGET, pixels))
        if budget is not None:
            from splatseed.seeding.upsampling import points_within  # noqa: PLC0415  (loads Numba)

            number = max(2, points_within(scene, budget))
        settings = TrainSettings(strategy="auto", max_steps=max_steps, cap_max=number)
        flags = "" if budget is None else f"--budget {number} "
        flags += "" if max_steps == FULL_RUN else f"--max-steps {max_steps} "
        # A trial's photographs are smaller, and so is its number of Gaussians.
        tuning = "" if budget is None else f" --budget {number / pixels:.3g}rho"
        tuning += "" if max_steps == FULL_RUN else f" --max-steps {max_steps}"
        most = most_seeds(settings, number)
        return cls(number, max_steps, settings.densification, most, flags, tuning)
