"""Accuracy of points lifted from depth maps, on two real captures.

Notation: *held out* is every eighth frame by name: its photograph and depth are never lifted from,
and its depth is the surface that new points are held against. A point is *judged* if in some
held-out frame it falls on a pixel with depth and not more than 5 cm behind it (behind, it is
hidden, and nothing is known). *error* is the distance of judged points to the nearest place of the
held-out surfaces, *off* the share of them over 5 cm away; *gap* is the distance from these surfaces
to the nearest point of the cloud, *bare* their share with no point within 5 cm. Promise: the
captures are only read; without them the script says so and ends.

Run it as ``python -m benchmarks.seeds.depth`` (some minutes, and one more for each capture the
first time: SfM points are triangulated and kept under ``--cache``).
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.common.clouds import find_scenes
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from scipy.spatial import cKDTree

import splatseed as ss
from splatseed.depth.alignment import map_camera
from splatseed.errors import SceneNotFoundError
from splatseed.io import find_depths
from splatseed.photos.loading import user_cache_dir
from splatseed.progress import in_threads, silent
from splatseed.scene import Scene

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # as the command line does

SCENES = Path(os.environ.get("SPLATSEED_SCENES", Path(__file__).parents[3] / "shared" / "scenes"))
CAPTURES = {"replica/room0": 2, "7scenes_redkitchen": 2}
"""Captures, and the step in pixels at which their held-out surfaces are sampled."""
HELD_OUT = 8
FAR = 0.05
RATIO = 16
GAP_SAMPLES = 50_000

ARMS: dict[str, tuple[str, str, dict[str, object]]] = {
    "mls": ("mls", "default", {}),
    "depth, paper": ("depth", "paper", {}),
    "depth, paper, planar": ("depth", "paper", {"unit_ray": False}),
    "depth, default": ("depth", "default", {}),
    "- least squares (eq. 7)": ("depth", "default", {"fit": "least-squares"}),
    "- all images": ("depth", "default", {"max_residual_ratio": None, "min_points": 1}),
    "- no synchronisation": ("depth", "default", {"synchronize_scales": False}),
    "- unit ray (eq. 9)": ("depth", "default", {"unit_ray": True}),
    "- the central half": ("depth", "default", {"central_fraction": 0.5}),
    "- uniform pixels": ("depth", "default", {"placement": "uniform"}),
    "- at jumps too": ("depth", "default", {"edge_tolerance": None}),
    "- confirmed by 1": ("depth", "default", {"min_agreeing": 1}),
    "- not confirmed": ("depth", "default", {"min_agreeing": 0}),
    "- seen through": ("depth", "default", {"see_through": True}),
    "- any colour": ("depth", "default", {"color_tolerance": None}),
    "- no other views": ("depth", "default", {"min_agreeing": 0, "see_through": True}),
    "- not spread": ("depth", "default", {"spread": False}),
    "- no views, no synchronisation": (
        "depth",
        "default",
        {"min_agreeing": 0, "see_through": True, "synchronize_scales": False},
    ),
}
"""Method, profile, and what differs from it; a dash is the default with one choice undone."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What the held-out frames see.

    Args:
        frames: The camera of each frame in pixels of its map, and the map's planar depth [H, W].
        surface: Their pixels in the world, [S, 3].
        tree: A tree of these.
    """

    frames: list[tuple[ss.Camera, np.ndarray]]
    surface: np.ndarray
    tree: cKDTree

    @classmethod
    def of(cls, scene: Scene, step: int) -> Truth:
        """The held-out frames of a scene, with every ``step``-th pixel as surface."""
        frames, surface = [], []
        for image in scene.split(HELD_OUT)[1]:
            depth = scene.depths.read(image.name)
            camera = map_camera(depth, image)
            frames.append((camera, depth.values))
            row, column = np.indices(depth.values.shape)[:, step // 2 :: step, step // 2 :: step]
            known = depth.values[row, column] > 0
            uv = np.stack([column[known], row[known]], axis=1) + 0.5
            surface.append(camera.unproject(uv, depth.values[row, column][known]))
        xyz = np.concatenate(surface)
        return cls(frames, xyz, cKDTree(xyz, balanced_tree=False))

    def judges(self, xyz: np.ndarray) -> np.ndarray:
        """Which points fall on known depth in some frame, and not far behind it, bool [N]."""
        judged = np.zeros(len(xyz), bool)
        for camera, depth in self.frames:
            uv, z = camera.project(xyz)
            inside = (z > 0) & ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)
            column, row = uv[inside].astype(int).T
            judged[np.flatnonzero(inside)[z[inside] < depth[row, column] + FAR]] = True
        return judged

    def distance(self, xyz: np.ndarray) -> np.ndarray:
        """Distance of points to the nearest place of the surface, [N]."""
        return query(self.tree, xyz)


@dataclass(frozen=True)
class Score:
    """How good new points are; see the top of the file."""

    judged: float
    error: float
    off: float
    gap: float
    bare: float

    @classmethod
    def of(cls, cloud: ss.PointCloud, truth: Truth) -> Score:
        """Judge the new points of a cloud."""
        new = cloud.xyz[cloud.source != 0].astype(np.float64)
        judged = truth.judges(new)
        error = truth.distance(new[judged])
        places = np.random.default_rng(0).choice(len(truth.surface), GAP_SAMPLES)
        gap = query(cKDTree(cloud.xyz, balanced_tree=False), truth.surface[places])
        return cls(
            float(judged.mean()) if len(new) else np.nan,
            float(np.median(error)) if len(error) else np.nan,
            float((error > FAR).mean()) if len(error) else np.nan,
            float(gap.mean()),
            float((gap > FAR).mean()),
        )

    def cells(self) -> list[str]:
        """As a row of a table."""
        cells = [
            f"{self.judged:.0%}",
            f"{1000 * self.error:.1f}",
            f"{self.off:.2%}",
            f"{1000 * self.gap:.0f}",
            f"{self.bare:.1%}",
        ]
        return ["" if "nan" in cell else cell for cell in cells]


def query(tree: cKDTree, xyz: np.ndarray) -> np.ndarray:
    """Distance of points to the nearest of a tree, on all cores."""
    distance = np.empty(len(xyz))

    def work(start: int, stop: int) -> None:
        distance[start:stop] = tree.query(xyz[start:stop])[0]

    in_threads(work, len(xyz), 1 << 14, "measure", silent)
    return distance


def main() -> None:
    """Print what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cache", type=Path, default=user_cache_dir().parent / "benchmarks")
    parser.add_argument("--arms", nargs="*", default=list(ARMS), help="quality of these alone")
    parser.add_argument("--scenes", nargs="*", default=list(CAPTURES), choices=list(CAPTURES))
    options = parser.parse_args()
    if not (SCENES / "replica/room0").is_dir():
        print(f"skipped: no captures in {SCENES}; set SPLATSEED_SCENES to their folder")
        return
    print(describe(), "\n")
    for name in options.scenes:
        print(quality_table(name, options), "\n", flush=True)


def quality_table(name: str, options: argparse.Namespace) -> str:
    """One capture: a row an arm."""
    scene = triangulated(name, options.cache)
    truth = Truth.of(scene, CAPTURES[name])
    clouds = {"SfM points": scene.points}
    for arm in options.arms:
        method, profile, changes = ARMS[arm]
        if method == "depth":
            changes = {"test_every": HELD_OUT, **changes}
        clouds[arm] = ss.upsample(scene, method, ratio=RATIO, profile=profile, **changes)
    header = [
        f"{name}, {len(scene.points):,} points, {RATIO}x",
        "judged",
        "error, mm",
        "off",
        "gap, mm",
        "bare",
    ]
    return table(header, [[arm, *Score.of(c, truth).cells()] for arm, c in clouds.items()])


def at_hand(names: Sequence[str]) -> list[str]:
    """Those scenes that need no capture, and the others where there are captures.

    Says which are skipped.
    """
    try:
        find_scenes()
    except SceneNotFoundError as error:
        print(f"skipped {', '.join(CAPTURES)}: {error}\n")
        return [name for name in names if name not in CAPTURES]
    return list(names)


def triangulated(name: str, cache: Path) -> Scene:
    """A capture with SfM points at its own poses, and its depth maps."""
    folder = cache / name.replace("/", "_")
    if not folder.is_dir():
        words = ["sfm", SCENES / name / "results", "--poses-from", SCENES / name, "-o", folder]
        folder.parent.mkdir(parents=True, exist_ok=True)
        program = Path(sys.executable).with_name("splatseed")
        subprocess.run([program, *map(str, words)], check=True)
    scene = ss.load_scene(folder)
    return scene.replace(depths=find_depths(scene, SCENES / name))


if __name__ == "__main__":
    main()
