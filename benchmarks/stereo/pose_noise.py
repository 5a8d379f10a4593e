"""Noise on known poses: what photographs tell of it, what it costs stereo, and what is mended.

Notation: noise of d degrees turns each camera by a rotation vector of d degrees at root mean
square, and moves it by d percent of the cameras' *extent*, the distance of the farthest from their
centroid. What is *left* after refining is the median over the cameras: of their turn against the
mean turn of all, and of their step after the best similarity between both sets of centres, since
nothing can tell the mean of the noise from the world's frame.
*Told* is what ``info`` says; *known* is the share of pixels with a depth that others confirm, and
*true* that of these within 5% of a depth camera's. Promise: captures are only read.

    python -m benchmarks.stereo.pose_noise
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from benchmarks.common.clouds import find_scenes
from benchmarks.common.ledger import report
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from benchmarks.stereo.truth import first, load, prepare, relative_error
from scipy.spatial.transform import Rotation

import splatseed as ss
from splatseed.camera import quat_from_rotation
from splatseed.checkup.pose_accuracy import estimate_pose_error
from splatseed.depth.stereo import stereo_depths
from splatseed.errors import ReconstructionError, SplatseedError
from splatseed.photos.loading import user_cache_dir
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.sfm import refined
from splatseed.similarity import fit_similarity

__all__: list[str] = []

MADE = "made room"
TRUE = 0.05


@dataclass(frozen=True)
class Options:
    """Measure captures at noisy poses, and at the same refined."""

    scenes: tuple[str, ...] = (MADE, "fern", "dorm", "replica/room0")
    """Captures by their names in the folder of captures, or the made room."""
    degrees: tuple[float, ...] = (0.0, 0.1, 0.5, 1.0, 2.0)
    """Noise."""
    limit: int = 24
    """Photographs at most, the first by name: features are matched between all of them."""
    cache: Path = user_cache_dir().parent / "benchmarks"
    """Where the made room is kept."""


def main(options: Options) -> None:
    """Measure, and print the table."""
    rows = [row for name in options.scenes for row in _rows(name, options)]
    before, after = (["told", "known", "true"], ["left: degrees, %", "told", "known", "true", "s"])
    print(f"{describe()}\n")
    print(table(["capture", "noise", *before, *(f"refined: {each}" for each in after)], rows))


def _rows(name: str, options: Options) -> Iterator[list[str]]:
    if name == MADE:
        prepare([name], options.cache)
    scene = load(name, options.cache) if name == MADE else ss.load_scene(
        find_scenes() / name, require_points=False
    )  # fmt: skip
    scene = first(scene, options.limit)
    for degrees in options.degrees:
        report(f"{name}, {degrees:g} degrees ...")
        noisy = _with_noise(scene, degrees, np.random.default_rng(0))
        start = time.perf_counter()
        try:
            mended = refined(noisy, 0)[0].replace(points=PointCloud.empty(), tracks=None)
        except ReconstructionError as refused:
            yield [name, f"{degrees:g}", *_seen(noisy, scene), f"refused: {refused.found}"]
            continue
        seconds = time.perf_counter() - start
        left = _left(scene, mended)
        yield [name, f"{degrees:g}", *_seen(noisy, scene), left, *_seen(mended, scene),
               f"{seconds:.0f}"]  # fmt: skip


def _with_noise(scene: Scene, degrees: float, rng: np.random.Generator) -> Scene:
    """The scene without points and depth maps, at noisy poses."""
    centers = np.stack([image.camera.center for image in scene.images])
    extent = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    images = []
    for image, center in zip(scene.images, centers, strict=True):
        turn, step = rng.normal(size=(2, 3)) / np.sqrt(3)
        R = Rotation.from_rotvec(np.radians(degrees) * turn).as_matrix()
        R = R @ image.camera.cam_from_world[:3, :3]
        moved = center + extent * degrees / 100 * step
        quat = quat_from_rotation(R)
        images.append(replace(image, quat=quat, translation=-R @ moved, observations=None))
    return scene.replace(images=tuple(images), points=PointCloud.empty(), tracks=None, depths=None)


def _seen(scene: Scene, truth: Scene) -> list[str]:
    """What photographs tell of their poses, and what stereo makes of them."""
    told = estimate_pose_error(scene, scene.images)
    known, errors = [], []
    for each in stereo_depths(scene):
        found = np.isfinite(each.depth)
        known.append(found.mean())
        if truth.depths is not None:
            errors.append(relative_error(each.depth, truth.depths.read(each.name).values)[found])
    error = np.concatenate(errors) if errors else np.empty(0)
    error = error[np.isfinite(error)]
    true = f"{(error < TRUE).mean():.0%}" if len(error) else ""
    return [str(told or "nothing"), f"{np.mean(known):.0%}", true]


def _left(scene: Scene, found: Scene) -> str:
    """Degrees, and percent of the cameras' extent, that the poses are still off."""
    posed = {image.name: image.camera for image in found.images}
    pairs = [(image.camera, posed[image.name]) for image in scene.images]
    true, other = (np.stack([pair[k].center for pair in pairs]) for k in (0, 1))
    fit = fit_similarity(other, true)
    moved = np.c_[other, np.ones(len(other))] @ fit.matrix.T
    steps = np.linalg.norm(moved - true, axis=1)
    extent = np.linalg.norm(true - true.mean(axis=0), axis=1).max()
    # The turn of one world against the other, by each camera; their mean is the frames'.
    turns = Rotation.from_matrix(
        [a.cam_from_world[:3, :3].T @ b.cam_from_world[:3, :3] for a, b in pairs]
    )
    apart = np.degrees((turns * turns.mean().inv()).magnitude())
    return f"{np.median(apart):.3f}, {100 * np.median(steps) / extent:.2f}"


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
