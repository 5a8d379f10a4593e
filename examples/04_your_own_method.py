"""Write an upsampling method of your own: a frozen dataclass that can be called.

python examples/04_your_own_method.py

It is used like any other: ``splatseed upsample --method examples/04_your_own_method.py:Jitter``.
docs/methods.md ("Your own method") shows how a package registers it under a short name.
"""

from dataclasses import dataclass

import numpy as np

import splatseed as ss
from splatseed.methods.neighbors import prepare_scene
from splatseed.progress import Progress


@dataclass(frozen=True)
class Jitter:
    """Points scattered about random originals."""

    radius: float = 0.5
    """Standard deviation, in units of the base point's spacing."""

    def __call__(
        self, scene: ss.Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> ss.PointCloud:
        """Make ``num_new`` points."""
        cloud = prepare_scene(scene, progress)  # the originals: clean, centred, with neighbours
        progress("jitter", 0.0)
        by_rank = np.argsort(cloud.rank)  # draw in file order, whatever order the rows have
        rows = by_rank[rng.integers(0, len(cloud), num_new)]
        steps = rng.standard_normal((num_new, 3)) * self.radius
        xyz = cloud.xyz[rows] + steps * cloud.neighbors(6).spacing[rows, None] + cloud.center
        progress("jitter", 1.0)
        return ss.PointCloud(xyz, cloud.rgb[rows])


def main() -> None:
    """Use it like any other method."""
    rng = np.random.default_rng(0)
    cloud = ss.PointCloud(rng.random((500, 3)), rng.integers(0, 256, (500, 3), np.uint8))
    seeds = ss.upsample(cloud, Jitter(radius=0.3), ratio=4, seed=0)
    print(f"{len(cloud)} points -> {len(seeds)}, {seeds.num_original} of them the originals")


if __name__ == "__main__":
    main()
