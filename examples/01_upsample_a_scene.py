"""Upsample a COLMAP scene and write one that every 3DGS trainer loads.

python examples/01_upsample_a_scene.py [SCENE] [OUT]

Without a scene of your own, a small made-up room takes its place.
"""

from __future__ import annotations

import sys
from pathlib import Path

import splatseed as ss
from splatseed.synthetic import make_capture, write_capture


def main(scene_dir: Path, out: Path) -> None:
    """Read, upsample, write."""
    if not scene_dir.exists():
        write_capture(make_capture(seed=0, num_views=12, width=200, height=150), scene_dir)

    scene = ss.load_scene(scene_dir)
    seeds = ss.upsample(scene)  # looks at the photographs
    report = ss.write_scene(scene.with_points(seeds), out, overwrite=True)

    print(f"{len(scene.images)} images, {len(scene.points):,} points -> {len(seeds):,}")
    print(f"written to {report.path} ({report.layout} layout)")


if __name__ == "__main__":
    words = [Path(word) for word in sys.argv[1:]]
    defaults = [Path("example_room"), Path("example_room_auto")]
    main(*words[:2], *defaults[len(words) :])
