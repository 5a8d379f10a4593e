"""What the check-up finds: captures as they are, and with faults of known kinds and strengths.

A fault is *found* if something is reported, *named* if it is reported as what it is; a *false
alarm* is a report on a capture as it is. Seconds are those of the processor, with compiled kernels
and reading photographs. Promise: captures are only read.

    python -m benchmarks.checkup
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial.transform import Rotation

import splatseed as ss
from benchmarks.common.clouds import find_scenes
from benchmarks.common.ledger import report
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from splatseed.camera import CAMERA_MODELS, quat_from_rotation
from splatseed.checkup.examination import UNFIT_POINTS, WRONG_FOCAL_LENGTH, comparable, examine
from splatseed.checkup.wrong_poses import WRONG_POSES, find_wrong_poses
from splatseed.errors import SplatseedError
from splatseed.scene import Image, Scene

__all__: list[str] = []

REFUSED = "refused"
FAULTY = 0.06
"""Share of the photographs whose poses are turned."""


@dataclass(frozen=True)
class Options:
    """Examine captures as they are, and with faults."""

    scenes: tuple[str, ...] = (
        "fern", "fox", "treehill", "bonsai", "dorm", "desk", "stone_horse", "face", "plush",
    )  # fmt: skip
    """Captures by their names in the folder of captures."""
    inputs: tuple[Path, ...] = ()
    """Other scenes, of which only what is reported is printed."""
    faults: bool = True
    """Also inject faults."""


Fault = Callable[[Scene], Scene]


def main(options: Options) -> None:
    """Examine all, and print the tables."""
    print(f"{describe()}\n")
    found: dict[str, list[tuple[set[str], str, float]]] = defaultdict(list)
    for name in options.scenes:
        scene = ss.load_scene(find_scenes() / name)
        _reported(scene)  # compiles kernels
        for fault, expected, change in _faults() if options.faults else [_NONE]:
            kinds, seconds = _reported(change(scene))
            report(f"{name}, {fault}: {', '.join(sorted(kinds)) or 'nothing'}, {seconds:.1f} s")
            found[fault].append((kinds, expected, seconds))
    rows = [_row(fault, results) for fault, results in found.items()]
    if rows:
        print(table(["fault", "captures", "found", "named", "seconds, median and most"], rows))
    for path in options.inputs:
        kinds, seconds = _reported(ss.load_scene(path, require_points=False))
        print(f"{path}: {', '.join(sorted(kinds)) or 'nothing'}, {seconds:.1f} s")


def _row(fault: str, results: list[tuple[set[str], str, float]]) -> list[str]:
    any_found = sum(bool(kinds) for kinds, _, _ in results)
    named = sum(expected in kinds for kinds, expected, _ in results)
    seconds = [each for _, _, each in results]
    times = f"{np.median(seconds):.1f}, {max(seconds):.1f}"
    return [fault, str(len(results)), str(any_found), str(named) if results[0][1] else "", times]


def _reported(scene: Scene) -> tuple[set[str], float]:
    """Return the kinds of what is reported, and the seconds of the processor."""
    start = time.process_time()
    images = comparable(scene)
    try:
        checkup = examine(scene, images)
        single = find_wrong_poses(scene, images, limit=100) if checkup.vouches else ()
        kinds = {each.kind for each in (*checkup.findings, *single)}
    except SplatseedError:
        kinds = {REFUSED}
    return kinds, time.process_time() - start


def _same(scene: Scene) -> Scene:
    return scene


_NONE: tuple[str, str, Fault] = ("none", "", _same)


def _faults() -> Iterator[tuple[str, str, Fault]]:
    """Names of faults, what should be reported, and what makes them."""
    yield _NONE
    yield "none, without tracks", "", lambda scene: scene.replace(tracks=None)
    for factor in (0.5, 0.8, 1.25):
        yield f"focal lengths x {factor}", WRONG_FOCAL_LENGTH, _focal(factor)
    yz, xy = np.diag([1.0, -1, -1, 1]), np.diag([-1.0, -1, 1, 1])
    poses: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "OpenGL's axes": lambda pose: yz @ pose,
        "x, y negated": lambda pose: xy @ pose,
        "inverted": np.linalg.inv,
    }
    for name, change in poses.items():
        yield f"poses: {name}", REFUSED, _posed(change)
    axes = {
        "x, -y, -z": np.diag([1.0, -1, -1]),
        "x, z, -y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
        "y, z, x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    }
    for name, matrix in axes.items():
        yield f"points: {name}", UNFIT_POINTS, _moved(matrix)
    for scale in (0.4, 1.3, 2.5):
        yield f"points: x {scale}, shifted", UNFIT_POINTS, _moved(scale * np.eye(3), 0.1)
    for size in (0.5, 1.0, 3.0):
        yield f"points: random in {size} of their extent", UNFIT_POINTS, _random(size)
    for degrees in (2.0, 4.0, 8.0):
        yield f"6% of the poses turned by {degrees:g} degrees", WRONG_POSES, _turned(degrees)


def _focal(factor: float) -> Fault:
    def change(scene: Scene) -> Scene:
        def scaled(image: Image) -> Image:
            lens, count = image.intrinsics, CAMERA_MODELS[image.intrinsics.model].num_focal
            params = (*(factor * each for each in lens.params[:count]), *lens.params[count:])
            return replace(image, intrinsics=replace(lens, params=params))

        return scene.replace(images=tuple(scaled(image) for image in scene.images))

    return change


def _posed(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    return lambda scene: scene.replace(
        images=tuple(_with_pose(image, change(image.cam_from_world)) for image in scene.images)
    )


def _with_pose(image: Image, pose: np.ndarray) -> Image:
    return replace(image, quat=quat_from_rotation(pose[:3, :3]), translation=pose[:3, 3])


def _moved(matrix: np.ndarray, shift: float = 0.0) -> Fault:
    def change(scene: Scene) -> Scene:
        xyz = scene.points.xyz.astype(np.float64)
        moved = xyz @ matrix.T + shift * np.ptp(np.percentile(xyz, [5, 95], axis=0), axis=0)
        return _with_positions(scene, moved)

    return change


def _random(size: float) -> Fault:
    def change(scene: Scene) -> Scene:
        low, high = np.percentile(scene.points.xyz, [5, 95], axis=0)
        middle, half = (low + high) / 2, size * (high - low) / 2
        rng = np.random.default_rng(0)
        return _with_positions(scene, middle + half * rng.uniform(-1, 1, scene.points.xyz.shape))

    return change


def _with_positions(scene: Scene, xyz: np.ndarray) -> Scene:
    """Without tracks: tools that move points seldom keep them."""
    points = scene.points.replace(xyz=xyz.astype(np.float32), normals=None)
    return scene.replace(points=points, tracks=None)


def _turned(degrees: float) -> Fault:
    def change(scene: Scene) -> Scene:
        rng = np.random.default_rng(0)
        count = len(scene.images)
        wrong = {*rng.permutation(count)[: max(1, round(FAULTY * count))].tolist()}
        axis = np.eye(3)[rng.integers(0, 3, count)]
        images = list(scene.images)
        for i in wrong:
            turn = np.eye(4)
            turn[:3, :3] = Rotation.from_rotvec(np.radians(degrees) * axis[i]).as_matrix()
            images[i] = _with_pose(images[i], turn @ images[i].cam_from_world)
        return scene.replace(images=tuple(images))

    return change


if __name__ == "__main__":
    main(tyro.cli(Options))
