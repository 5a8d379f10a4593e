"""Compare all methods on known surfaces, where errors can be measured.

python examples/03_compare_methods.py

Distances are in units of the spacing of the original points: *error* from the new points to the
surface, *coverage* from the surface to the nearest point. Lower is better in both.
"""

from __future__ import annotations

import numpy as np

import splatseed as ss
from splatseed.seeding.geometry_score import mean_spacing, measure
from splatseed.synthetic import SHAPES, Surface

NUM_POINTS = 2000
NOISE = 0.1
"""Standard deviation of the original points, in units of their spacing."""
NEED_PHOTOGRAPHS = ("depth", "stereo", "cover", "auto", "cloud")


def noisy_cloud(surface: Surface, rng: np.random.Generator) -> ss.PointCloud:
    """Sample a surface with noise, as Structure-from-Motion would."""
    xyz = surface.sample(NUM_POINTS, rng)
    xyz += NOISE * mean_spacing(xyz) * rng.normal(size=xyz.shape)
    return ss.PointCloud(xyz, np.full(xyz.shape, 128, np.uint8))


def score(surface: Surface, method: str) -> tuple[float, float]:
    """Measure the error and coverage of a method at ratio 8."""
    rng = np.random.default_rng(0)
    cloud = noisy_cloud(surface, rng)
    seeds = ss.upsample(cloud, method, ratio=8, seed=0)
    new = seeds.xyz[len(cloud) :]
    result = measure(new, seeds.xyz, surface, surface.sample(2000, rng), mean_spacing(cloud.xyz))
    return result.error, result.coverage


def main() -> None:
    """Print a row per shape and a column per method."""
    methods = [name for name in ss.METHODS if name not in NEED_PHOTOGRAPHS]
    print("error / coverage".ljust(18) + "".join(f"{method:>15}" for method in methods))
    for name, make_shape in SHAPES.items():
        scores = [score(make_shape(), method) for method in methods]
        cells = [f"{error:.3f} / {coverage:.3f}" for error, coverage in scores]
        print(name.ljust(18) + "".join(f"{cell:>15}" for cell in cells))


if __name__ == "__main__":
    main()
