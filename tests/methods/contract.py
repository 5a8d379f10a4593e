"""What the contract suite runs over: every method in every profile, a third party's too."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import splatseed as ss
from splatseed.methods.neighbors import prepare_scene
from splatseed.scene import Scene
from splatseed.seeding.upsampling import upsample_checked

from .surroundings import scene_around


@dataclass(frozen=True)
class Copies:
    """A third party's method: copies of random originals."""

    def __call__(self, scene, num_new, rng, progress):
        progress("copies", 0.0)
        cloud = prepare_scene(scene)
        row_of_rank = np.argsort(cloud.rank)
        rows = row_of_rank[rng.integers(0, len(cloud), num_new)]
        return (cloud.xyz[rows] + cloud.center).astype(np.float32), cloud.rgb[rows]


@dataclass(frozen=True)
class Kind:
    """A method in one of its profiles, and what may be asked of it."""

    method: str
    profile: str

    def __str__(self) -> str:
        return f"{self.method}-{self.profile}"

    @property
    def turns_with_the_cloud(self) -> bool:
        """Neither the fit nor the box it samples stands on the world's axes."""
        if self.method in {"random", "depth"}:  # our made scene stands on the axes, too
            return False
        return self.profile == "default" or self.method in {"linear", "triangle", "copies"}

    @property
    def stays_on_flat_sets(self) -> bool:
        """New points of a line or plane lie on it; cells and boxes reach beyond."""
        return self.turns_with_the_cloud and self.method != "voronoi"

    @property
    def takes_any_cloud(self) -> bool:
        """One point is enough."""
        return self.method in {"random", "copies"}

    @property
    def needs_scene(self) -> bool:
        """Points alone will not do."""
        return self.method == "depth"

    def __call__(self, cloud, **options):
        """Upsample ``cloud``, four times unless told otherwise; in a made scene if it takes one."""
        if self.needs_scene:  # whose photographs, all alike, contradict its points: not examined
            scene = scene_around(cloud)
            scene = scene if isinstance(scene, Scene) else Scene(scene)
            return upsample_checked(scene, self.method, profile=self.profile, **options)
        return ss.upsample(cloud, self.method, profile=self.profile, **options)

    def new(self, cloud, num_new, **options):
        """Only the new points."""
        seeds = self(cloud, num_points=len(cloud) + num_new, **options)
        return seeds.select(slice(len(cloud), None))


METHOD_NAMES = ("linear", "triangle", "spline", "mls", "voronoi", "depth", "random", "copies")
PHOTOGRAPH_METHODS = ("stereo", "cover", "auto")
"""Those that make as many points as the photographs need: tests/seeding holds them to the
contract."""
KINDS = [Kind(method, profile) for method in METHOD_NAMES for profile in ("default", "paper")]


def named(**expectation: bool) -> list[Kind]:
    """The kinds of which a property holds, such as ``turns_with_the_cloud=True``."""
    ((name, value),) = expectation.items()
    return [kind for kind in KINDS if getattr(kind, name) is value]
