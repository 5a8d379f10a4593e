"""Depth-guided lifting (paper, eqs. 7-9): points at pixels with known depth.

P = c + z v, with c the camera's centre, v the ray through the pixel's centre and z its depth,
scaled to the scene by the SfM points of the image. ``splatseed.depth`` does the work; here are the
method's parameters and their limits. Promise: every new point is the centre of a map's pixel, at
its depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np

from splatseed.depth.settings import DepthSettings
from splatseed.io.regions import Region
from splatseed.methods.contract import Traits
from splatseed.pointcloud import PointCloud
from splatseed.progress import Note, Progress, silent_note
from splatseed.scene import Scene
from splatseed.settings import check_settings


@dataclass(frozen=True)
class Depth(DepthSettings):
    """Pixels lifted by depth maps (eqs. 7-9), which also fills untextured areas."""

    name: ClassVar[str] = "depth"

    def __post_init__(self) -> None:
        check_settings(self, self.name)

    traits: ClassVar[Traits] = Traits(frozenset({"depth"}))

    def suggested_number(self, scene: Scene) -> int:
        """Return the number of points to make for a scene without any."""
        from splatseed.depth.lifting import suggested_number

        return suggested_number(scene, self)

    @classmethod
    def paper(cls) -> Self:
        """Return the parameters of the paper's text."""
        return cls(
            fit="least-squares", min_points=1, max_residual_ratio=None, synchronize_scales=False,
            unit_ray=True, central_fraction=0.5, placement="uniform", edge_tolerance=None,
            min_agreeing=0, see_through=True, color_tolerance=None, spread=False,
        )  # fmt: skip

    def __call__(
        self,
        scene: Scene,
        num_new: int,
        rng: np.random.Generator,
        progress: Progress,
        *,
        region: Region | None = None,
        note: Note = silent_note,
    ) -> PointCloud:
        """Lift ``num_new`` pixels."""
        from splatseed.depth.lifting import lift

        xyz, rgb, findings = lift(scene, num_new, self, rng, progress, region)
        for finding in findings:
            note(finding)
        return PointCloud(xyz, rgb)
