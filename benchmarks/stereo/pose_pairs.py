"""Refinement of poses by pairs whose views overlap, and by all pairs: accuracy and time.

Each arm detects features, matches pairs and refines the poses of a capture's first photographs.
The *miss* of a match is its distance from the epipolar line, in pixels of the photograph: the
matches are those of all pairs with ``MIN_MATCHES`` and more, of the arm that matches all. Seconds
are of the processors. Promise: captures are only read.

    python -m benchmarks.stereo.pose_pairs
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from benchmarks.common.clouds import find_scenes
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from benchmarks.stereo.truth import first
from benchmarks.training.baseline import say

import splatseed as ss
from splatseed.errors import SplatseedError
from splatseed.io.photograph import photograph_folder
from splatseed.progress import silent
from splatseed.scene import Image
from splatseed.sfm.colmap import Run, Settings, posed_model, require_pycolmap
from splatseed.sfm.matching import match_photographs
from splatseed.sfm.refinement import refine

__all__: list[str] = []

ARMS = {
    "all pairs": Settings("exhaustive"),
    "pairs that overlap": Settings(),
    "and photographs not doubled": Settings(max_image_size=2000, doubled=False),
}
MIN_MATCHES = 30
FAR = 10
"""Photographs between the two of a far pair, by name."""
MOST_PX = 4.0
"""Misses of wrong matches count as much, in the mean."""


@dataclass(frozen=True)
class Options:
    """Refine the poses of captures by several choices of features and pairs."""

    scenes: tuple[str, ...] = ("corridor",)
    """Captures by their names in the folder of captures."""
    limit: int = 40
    """Photographs at most, the first by name."""


@dataclass(frozen=True)
class Matches:
    """Verified matches of two photographs."""

    pair: tuple[int, int]
    rays: tuple[Any, Any]  # on the planes at depth 1, float64 [M, 2] each


def main(options: Options) -> None:
    """Measure, and print the table."""
    rows = [row for name in options.scenes for row in _rows(name, options)]
    misses = ["median", f"mean, {MOST_PX:g} px at most", f"{FAR} and more apart, median"]
    print(f"{describe()}\n")
    print(table(["capture", "poses", "pairs", "seconds", "reprojection, px", *misses], rows))


def _rows(name: str, options: Options) -> Iterator[list[str]]:
    scene = first(ss.load_scene(find_scenes() / name, require_points=False), options.limit)
    given = sorted(scene.images, key=lambda image: image.name)
    matches: list[Matches] = []
    for arm, settings in ARMS.items():
        say(f"{name}, {arm} ...")
        with tempfile.TemporaryDirectory() as folder:
            pycolmap = require_pycolmap()
            run = Run(pycolmap, settings, photograph_folder(scene), Path(folder), silent)
            start = os.times()
            model = posed_model(pycolmap, given)
            match_photographs(run, model, scene.masks, given)
            found, how = refine(run, given)
            end = os.times()
            if not matches:
                matches = _matches(run, model, len(given))
                yield [
                    name,
                    "as given",
                    "",
                    "",
                    f"{how.error_before:.2f}",
                    *_misses(given, matches),
                ]
            seconds = end.user + end.system - start.user - start.system
            cells = [f"{run.num_pairs()}", f"{seconds:.0f}", f"{how.error_after:.2f}"]
            yield [name, f"refined, {arm}", *cells, *_misses(found, matches)]


def _matches(run: Run, model: Any, number: int) -> list[Matches]:
    """The verified matches of all pairs; image ids count from 1."""
    with run.pycolmap.Database.open(run.database) as database:
        rays = [
            model.image(i).camera.cam_from_img(database.read_keypoints(i)[:, :2].astype(np.float64))
            for i in range(1, number + 1)
        ]
        pairs = [(i, j) for i in range(number) for j in range(i + 1, number)]
        found = [database.read_two_view_geometry(i + 1, j + 1).inlier_matches for i, j in pairs]
    return [
        Matches((i, j), (rays[i][rows[:, 0]], rays[j][rows[:, 1]]))
        for (i, j), rows in zip(pairs, found, strict=True)
        if len(rows) >= MIN_MATCHES
    ]


def _misses(images: Sequence[Image], matches: Sequence[Matches]) -> list[str]:
    """Median and mean miss, and the median over far pairs of their medians, px."""
    focal = float(np.median([image.camera.K[0, 0] for image in images]))
    misses = [focal * _miss(images, each) for each in matches]
    far = [
        np.median(miss)
        for each, miss in zip(matches, misses, strict=True)
        if each.pair[1] - each.pair[0] >= FAR
    ]
    every = np.concatenate(misses)
    mean = np.minimum(every, MOST_PX).mean()
    return [f"{np.median(every):.2f}", f"{mean:.2f}", f"{np.median(far):.2f}" if far else ""]


def _miss(images: Sequence[Image], matches: Matches) -> np.ndarray:
    """Sampson distances of matches at focal length 1 (Hartley and Zisserman 2004, eq. 11.9)."""
    one, other = (images[i].camera for i in matches.pair)
    relative = other.cam_from_world @ one.world_from_cam
    x, y, z = relative[:3, 3]
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:3, :3]
    a, b = (np.hstack([rays, np.ones((len(rays), 1))]) for rays in matches.rays)
    of_b, of_a = a @ essential.T, b @ essential
    gradient = np.hypot(np.hypot(of_b[:, 0], of_b[:, 1]), np.hypot(of_a[:, 0], of_a[:, 1]))
    return np.asarray(np.abs((b * of_b).sum(axis=1)) / gradient)


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
