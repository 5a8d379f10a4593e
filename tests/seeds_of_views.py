"""The view that each seed comes from: seeds are made view by view."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import numpy as np
import pytest

from splatseed.pointcloud import PointCloud


def seeds_of_views(
    module: ModuleType, idx_of: Callable[..., int], make: Callable[[], PointCloud]
) -> tuple[PointCloud, np.ndarray]:
    """The seeds that ``make`` gives, and for each the index of its view.

    ``idx_of`` returns it from the arguments of the module's ``make_seeds``.
    """
    parts: list[tuple[int, int]] = []
    make_seeds = module.make_seeds

    def recorded(*arguments):
        seeds = make_seeds(*arguments)
        parts.append((idx_of(*arguments), len(seeds)))
        return seeds

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "make_seeds", recorded)
        seeds = make()
    idx, counts = np.array(parts).T
    return seeds, np.repeat(idx, counts)
