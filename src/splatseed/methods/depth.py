"""Depth-guided lifting (paper, eqs. 7-9): pixels with known depth become points.

P = c + z v, with c the camera's centre, v the ray through the pixel's centre and z its depth,
scaled to the scene by the SfM points of the image. ``splatseed.depth`` does the work; here are the
method's parameters and their limits. Promise: every new point is the centre of a map's pixel, at
its depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from splatseed.depth.alignment import Settings
from splatseed.methods.method import NewPoints, Traits, check_fields, require
from splatseed.progress import Progress
from splatseed.scene import Scene

MAX_VIEWS = 255


@dataclass(frozen=True)
class Depth(Settings):
    """Pixels lifted by depth maps (eqs. 7-9), which also fills untextured areas."""

    name: ClassVar[str] = "depth"

    def __post_init__(self) -> None:
        check_fields(self)
        edge, color, views = self.edge_tolerance, self.color_tolerance, self.num_neighbors
        ratio = self.max_residual_ratio
        for field, fits, expected in (
            ("min_points", self.min_points >= 1, "of at least 1"),
            ("region", 0 < self.region <= 1, "above 0, 1 at most"),
            ("max_residual_ratio", ratio is None or ratio >= 1, "of at least 1"),
            ("edge_tolerance", edge is None or edge > 0, "above 0"),
            ("edge_radius", 1 <= self.edge_radius <= 100, "from 1 to 100"),
            ("num_neighbors", 1 <= views <= MAX_VIEWS, f"from 1 to {MAX_VIEWS}"),
            ("min_agreeing", 0 <= self.min_agreeing <= views, f"from 0 to {views}"),
            ("tolerance", 0 < self.tolerance < 1, "between 0 and 1"),
            ("color_tolerance", color is None or 0 < color <= 1, "above 0, 1 at most"),
        ):
            require(fits, f"depth.{field} {expected}", getattr(self, field))

    @property
    def traits(self) -> Traits:
        """Maps in scene units need no originals for alignment."""
        return Traits(frozenset({"points", "depth"} if self.align else {"depth"}))

    @classmethod
    def paper(cls) -> Self:
        """The parameters that follow the paper to the letter."""
        return cls(
            fit="least-squares", min_points=1, max_residual_ratio=None, synchronize_scales=False,
            unit_ray=True, region=0.5, placement="uniform", edge_tolerance=None, min_agreeing=0,
            see_through=True, color_tolerance=None, spread=False,
        )  # fmt: skip

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Lift ``num_new`` pixels."""
        from splatseed.depth.lifting import lift  # noqa: PLC0415  (its kernels load with its use)

        return NewPoints(*lift(scene, num_new, self, rng, progress))
