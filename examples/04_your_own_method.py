"""Write an upsampling method of your own: a frozen dataclass that can be called.

python examples/04_your_own_method.py

It is used like any other. To have it in METHODS, and so as a choice of ``splatseed upsample`` with
its fields as flags, let your package register it in its pyproject.toml:

    [project.entry-points."splatseed.methods"]
    jitter = "your_package.jitter:Jitter"
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import splatseed as ss
from splatseed.methods import NewPoints
from splatseed.methods.neighbors import prepare_scene
from splatseed.progress import Progress
from splatseed.scene import Scene


@dataclass(frozen=True)
class Jitter:
    """Copies of the originals, moved by a random step."""

    sigma: float = 0.5
    """Standard deviation of the step, in units of the point's spacing."""

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Make ``num_new`` points."""
        cloud = prepare_scene(scene, progress)  # the originals: clean, centred, with neighbours
        progress("jitter", 0.0)
        h = cloud.neighbors(6).spacing
        base = rng.integers(len(cloud), size=num_new)
        step = self.sigma * h[base, None] * rng.normal(size=(num_new, 3))
        xyz = cloud.xyz[base] + step + cloud.center
        progress("jitter", 1.0)
        return NewPoints(xyz.astype(np.float32), cloud.rgb[base])


def main() -> None:
    """Use it like any other method."""
    rng = np.random.default_rng(0)
    cloud = ss.PointCloud(rng.random((500, 3)), rng.integers(0, 256, (500, 3), np.uint8))
    seeds = ss.upsample(cloud, Jitter(sigma=0.3), ratio=4, seed=0)
    print(f"{len(cloud)} points -> {len(seeds)}, {seeds.num_original} of them the originals")


if __name__ == "__main__":
    main()
