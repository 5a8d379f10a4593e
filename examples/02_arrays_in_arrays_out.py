"""Upsample points that are not in a scene: NumPy arrays in, NumPy arrays out.

python examples/02_arrays_in_arrays_out.py
"""

from __future__ import annotations

import numpy as np

import splatseed as ss


def main() -> None:
    """Make half a sphere ten times as dense, and see how round it stays."""
    rng = np.random.default_rng(0)
    xyz = rng.normal(size=(2000, 3))
    xyz /= np.linalg.norm(xyz, axis=1, keepdims=True)
    xyz[:, 2] = np.abs(xyz[:, 2])
    rgb = (255 * np.abs(xyz)).astype(np.uint8)

    cloud = ss.PointCloud(xyz, rgb)
    for method in ("linear", "mls"):
        seeds = ss.upsample(cloud, method, ratio=10, seed=0)
        radius = np.linalg.norm(seeds.xyz[len(xyz) :], axis=1)
        off = np.abs(radius - 1).mean()
        print(f"{method:8}{len(seeds):,} points {seeds.rgb.dtype}, new ones {off:.5f} off")

    # A method's own parameters go along by name; a wrong one is named in one line.
    ss.upsample(cloud, "mls", ratio=2, k=24, placement="triangle")
    try:
        ss.upsample(cloud, "mls", ratio=2, neighbours=24)
    except ss.SplatseedError as error:
        print(f"error: {error}")


if __name__ == "__main__":
    main()
