"""What the check-up finds: captures as they are, and with faults of known kinds and strengths.

A *variant* is a capture as it is, without points or tracks, or with a fault. It is *found* if
something is reported as an error, and *named* if what is wrong is said: the axes, the factor, the
similarity, or every photograph. An error about a capture as it is is a *false alarm*. Seconds are
the processor's, with compiled kernels and reading photographs. Captures are only read. Captures
without points get those of their depth maps or of stereo, so that these can be spoilt.

    python -m benchmarks.checkup                                      # all, from where it stopped
    python -m benchmarks.checkup --captures fern --hard --no-cases    # one capture
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

import splatseed as ss
from benchmarks.common.clouds import find_cases, find_scenes
from benchmarks.common.hard_captures import HARD_CAPTURES, make_hard_capture
from benchmarks.common.ledger import read_ledger, report, write_line
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from benchmarks.common.skipping import or_skip
from splatseed.camera import CAMERA_MODELS, quat_from_rotation
from splatseed.checkup.examination import UNFIT_POINTS, WRONG_FOCAL_LENGTH, comparable
from splatseed.checkup.poses import CORRECTIONS
from splatseed.checkup.wrong_poses import WRONG_POSES
from splatseed.commands.capture_check import check_capture
from splatseed.depthmap import DepthMap, DepthMaps, in_scene_units
from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.pointcloud import PointCloud
from splatseed.progress import silent
from splatseed.scene import Image, Scene
from splatseed.seeding.map_seeds import UNIT_MISMATCH, unit_ratio
from splatseed.synthetic.capture import make_capture, write_capture

__all__: list[str] = []

DEVELOPED = ("fern", "fox", "treehill", "bonsai", "dorm", "desk", "stone_horse", "face", "plush")
"""Captures on which thresholds were chosen."""
LEFT_OUT = (
    "replica/room0", "7scenes_redkitchen", "corridor", "llff/fern", "llff/flower", "llff/horns",
    "mipnerf360_sfm/bicycle", "mipnerf360_sfm/stump",
)  # fmt: skip
"""Captures that had no part in it."""
REFUSED = "photographs-disagree"
FAULTY = 0.06
"""Share of the photographs whose poses are turned."""
MADE_POINTS = 8000
"""Points made for captures without any."""
WRONG_CASES: Mapping[str, str] = {
    "wrong_convention/inv": REFUSED, "wrong_convention/gl": REFUSED,
    "wrong_convention/json": REFUSED, "ply_axes/cv": UNFIT_POINTS, "ply_axes/zup": UNFIT_POINTS,
    "ply_axes/scale": UNFIT_POINTS, "blender_random/with": UNFIT_POINTS,
    "network_focal/a": WRONG_FOCAL_LENGTH, "network_focal/b": WRONG_FOCAL_LENGTH,
    "distorted_photos/same": "wrong-distortion", "distorted_photos/off": "wrong-distortion",
}  # fmt: skip
"""What must be reported of inputs that builders make; of their others nothing is wrong, or what is
wrong is mended when they are read."""


Key = tuple[str, str]
"""A capture and its variant."""
Result = dict[str, Any]
Fault = Callable[[Scene], Scene]
Named = Callable[["Report", Scene, Scene], bool]
"""Whether a report says what is wrong with a spoilt scene (the last), made of another."""


@dataclass(frozen=True)
class Options:
    """Check captures as they are, and with faults."""

    captures: tuple[str, ...] = (*LEFT_OUT, *DEVELOPED)
    """Captures by their names in the folder of captures."""
    hard: tuple[str, ...] = tuple(HARD_CAPTURES)
    """Made captures that are right, but hard to confirm."""
    cases: bool = True
    """Also check the inputs that the builders of SPLATSEED_CASES make."""
    faults: tuple[str, ...] = ("focal", "poses", "points", "turned", "depth")
    """Faults to inject: those whose names begin so."""
    ledger: Path = Path("checkup.jsonl")
    """Results so far; what is in it is not measured again."""


@dataclass(frozen=True)
class Variant:
    """A capture with a fault, or with none."""

    name: str
    change: Fault
    kind: str = ""  # of the finding that should be reported; empty if nothing is wrong
    named: Named = lambda _report, _scene, _spoilt: True


@dataclass(frozen=True)
class Report:
    """What was reported about a scene."""

    findings: tuple[Finding, ...]
    affine: Float64[np.ndarray, "3 4"] | None = None  # that makes its points fit

    @property
    def errors(self) -> tuple[Finding, ...]:
        """What does not fit."""
        return tuple(each for each in self.findings if each.severity == "error")

    @property
    def text(self) -> str:
        """All errors as they are printed."""
        return " ".join(map(str, self.errors))


def main(options: Options) -> None:
    """Check all that the ledger lacks, and print the tables."""
    print(f"{describe()}\n")
    groups: dict[str, list[Key]] = defaultdict(list)
    for name in options.captures:
        group = "chosen on" if name in DEVELOPED else "left out"
        or_skip(name, lambda name=name, group=group: groups[group].extend(_captured(name, options)))
    for name in options.hard:
        groups["hard"].append(_hard(name, options.ledger))
    if options.cases:
        or_skip("inputs", lambda: groups["inputs"].extend(_cases(options.ledger)))
    done = read_ledger(options.ledger)
    for group, keys in groups.items():
        rows: dict[str, list[Result]] = defaultdict(list)
        for key in keys:
            rows[key[1]].append(done[key])
        header = [group, "right", "captures", "found", "named", "seconds, median and most"]
        print(f"{table(header, (_row(*each) for each in rows.items()))}\n")


def _row(variant: str, results: Sequence[Result]) -> list[str]:
    found, named = (sum(result[key] for result in results) for key in ("found", "named"))
    seconds = [result["seconds"] for result in results]
    times = f"{np.median(seconds):.1f}, {max(seconds):.1f}"
    kind = results[0]["right"]
    counts = [str(len(results)), str(found), str(named) if kind else ""]
    return [variant, kind or "nothing", *counts, times]


def _captured(name: str, options: Options) -> list[Key]:
    """Check the variants of a capture."""
    scene = ss.load_scene(find_scenes() / name, require_points=False)
    done, keys = read_ledger(options.ledger), list[Key]()
    pointed = cache(lambda: scene if len(scene.points) else _with_points(scene))
    for variant in _variants(scene, options.faults):
        keys.append((name, variant.name))
        if keys[-1] not in done:
            as_read = variant.name == "as it is" or variant.name.startswith("depth")
            _measure(keys[-1], variant, scene if as_read else pointed(), options.ledger)
    return keys


def _hard(name: str, ledger: Path) -> Key:
    """Check a made capture of which nothing is wrong."""
    key = ("made", name)
    if key not in read_ledger(ledger):
        with TemporaryDirectory() as folder:
            scene = make_hard_capture(name, Path(folder) / "capture")
            _measure(key, Variant(name, _same), scene, ledger)
    return key


def _cases(ledger: Path) -> list[Key]:
    """Check the scenes that builders make."""
    done, keys = read_ledger(ledger), list[Key]()
    for builder in sorted((find_cases() / "inputs").glob("*.py")):
        with TemporaryDirectory() as made:
            folder = Path(made) / builder.stem
            build = [sys.executable, "-B", builder.name, str(folder)]  # -B: writes nothing there
            subprocess.run(build, cwd=builder.parent, check=True, capture_output=True)
            for path in _scenes_in(folder) if folder.is_dir() else ():  # ``made.py`` is their tool
                case = path.relative_to(made).as_posix()
                keys.append(("input", case))
                if keys[-1] in done:
                    continue
                try:
                    scene = ss.load_scene(path, require_points=False)
                except SplatseedError as error:
                    report(f"{case} cannot be read: {error}")
                    keys.pop()
                    continue
                variant = Variant(case, _same, WRONG_CASES.get(case, ""))
                _measure(keys[-1], variant, scene, ledger)
    return keys


def _scenes_in(folder: Path) -> Iterator[Path]:
    if (folder / "sparse").is_dir() or any(folder.glob("transforms*.json")):
        yield folder
        return
    for child in sorted(filter(Path.is_dir, folder.iterdir())):
        yield from _scenes_in(child)


def _measure(key: Key, variant: Variant, scene: Scene, ledger: Path) -> None:
    """Check a variant, and write down what was reported."""
    spoilt = variant.change(scene)
    _warm(ledger)
    start = time.process_time()
    said = _report(spoilt)
    seconds = time.process_time() - start
    kinds = sorted({each.kind for each in said.errors})
    result: Result = {
        "right": variant.kind, "kinds": kinds, "found": bool(kinds), "seconds": seconds,
        "named": variant.kind in kinds and variant.named(said, scene, spoilt),
        "remarks": sorted({each.kind for each in said.findings} - set(kinds)), "said": said.text,
        "subjects": sorted({name for each in said.errors for name in each.subjects}),
    }  # fmt: skip
    report(f"{' '.join(key)}: {', '.join(kinds) or 'nothing'}, {result['named']}, {seconds:.1f} s")
    write_line(ledger, key, result)


@cache
def _warm(ledger: Path) -> None:  # noqa: ARG001  (once for a run)
    """Compile and load all kernels."""
    scene = make_capture(num_views=8, width=160, height=120)
    with TemporaryDirectory() as folder:
        path = write_capture(scene, Path(folder) / "capture")
        _report(_moved(np.diag([1.0, -1, -1]))(ss.load_scene(path)))


def _report(scene: Scene) -> Report:
    """Return what ``splatseed info`` finds out by comparing photographs."""
    check = check_capture(scene, 0.0, silent)
    findings = check.findings
    if in_scene_units(scene.depths) and (ratio := unit_ratio(scene, comparable(scene))):
        findings += (Finding(UNIT_MISMATCH, f"{ratio:.4g} times", "error"),)
    return Report(findings, check.points.scene_from_points if check.points else None)


def _with_points(scene: Scene) -> Scene:
    """Give a capture the points that its depth maps or stereo show, as if they were its own."""
    if scene.depths is not None:
        points = ss.upsample(scene, "depth", num_points=MADE_POINTS)
    else:
        points = ss.upsample(scene, "stereo", budget=MADE_POINTS)
    return scene.with_points(PointCloud(points.xyz, points.rgb))


def _variants(scene: Scene, faults: Sequence[str]) -> Iterator[Variant]:
    yield Variant("as it is", _same)
    if not scene.has_photographs:
        return
    if not len(scene.points):
        yield Variant("points of depth maps or stereo", _same)
    else:
        yield Variant("without points", lambda scene: scene.with_points(PointCloud.empty()))
    if scene.tracks is not None:
        yield Variant("without tracks", lambda scene: scene.replace(tracks=None))
    yield from (each for each in _faults(scene) if each.name.startswith(tuple(faults)))


def _same(scene: Scene) -> Scene:
    return scene


def _faults(scene: Scene) -> Iterator[Variant]:
    for factor in (0.5, 0.8, 1.25):
        yield Variant(
            f"focal lengths x {factor}", _focal(factor), WRONG_FOCAL_LENGTH, _says(1 / factor)
        )
    yz, xy = np.diag([1.0, -1, -1, 1]), np.diag([-1.0, -1, 1, 1])
    # What each correction makes right again.
    mistakes: Sequence[Callable[[np.ndarray], np.ndarray]] = (
        lambda pose: yz @ pose, lambda pose: xy @ pose, np.linalg.inv,
        lambda pose: np.linalg.inv(yz @ pose),
    )  # fmt: skip
    for name, mistake in zip(CORRECTIONS, mistakes, strict=True):
        yield Variant(f"poses: {name}", _posed(mistake), REFUSED, _says(f"once {name}."))
    axes = {
        "x, -y, -z": np.diag([1.0, -1, -1]),
        "x, z, -y": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
        "y, z, x": np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]),
    }
    for name, matrix in axes.items():
        yield Variant(f"points: {name}", _moved(matrix), UNFIT_POINTS, _moves_back)
    for scale in (0.4, 1.3, 2.5):
        change = _moved(scale * np.eye(3), 0.1)
        yield Variant(f"points: x {scale}, shifted", change, UNFIT_POINTS, _moves_back)
    for size in (0.5, 1.0, 3.0):
        name = f"points: random in {size} of their extent"
        yield Variant(name, _random(size), UNFIT_POINTS)
    for degrees in (2.0, 4.0, 8.0):
        name = f"turned by {degrees:g} degrees: 6% of the poses"
        yield Variant(name, _turned(degrees), WRONG_POSES, _names_turned)
        if scene.tracks is not None:
            name += ", without tracks"
            yield Variant(name, _turned(degrees, tracks=False), WRONG_POSES, _names_turned)
    if in_scene_units(scene.depths):
        for factor in (0.3, 2.5, 1000.0):
            yield Variant(f"depth maps x {factor:g}", _deeper(factor), UNIT_MISMATCH, _says(factor))


def _says(what: str | float) -> Named:
    """Whether the text has these words, or a factor of about this number."""

    def named(said: Report, _scene: Scene, _spoilt: Scene) -> bool:
        if isinstance(what, str):
            return what in said.text
        factors = map(float, re.findall(r"([\d.]+(?:e[+-]\d+)?) times", said.text))
        return any(abs(factor / what - 1) < 0.05 for factor in factors)

    return named


def _moves_back(said: Report, scene: Scene, spoilt: Scene) -> bool:
    """Whether the map that is given moves points back, to within 5% of their spread."""
    if said.affine is None:
        return False
    xyz = scene.points.xyz.astype(np.float64)
    moved = spoilt.points.xyz @ said.affine[:, :3].T + said.affine[:, 3]
    spread = np.median(np.linalg.norm(xyz - np.median(xyz, axis=0), axis=1))
    return bool(np.median(np.linalg.norm(moved - xyz, axis=1)) < 0.05 * spread)


def _names_turned(said: Report, scene: Scene, spoilt: Scene) -> bool:
    """Whether exactly the turned photographs are named."""
    both = zip(scene.images, spoilt.images, strict=True)
    turned = {a.name for a, b in both if not np.array_equal(a.quat, b.quat)}
    return turned == {name for each in said.errors for name in each.subjects}


@dataclass(frozen=True)
class _Deeper:
    """Depth maps in another unit."""

    maps: DepthMaps
    factor: float
    in_scene_units: bool = True

    def __contains__(self, name: object) -> bool:
        return name in self.maps

    def __iter__(self) -> Iterator[str]:
        return iter(self.maps)

    def __len__(self) -> int:
        return len(self.maps)

    def read(self, name: str) -> DepthMap:
        depth = self.maps.read(name)
        return replace(depth, values=depth.values * np.float32(self.factor))


def _deeper(factor: float) -> Fault:
    def change(scene: Scene) -> Scene:
        assert scene.depths is not None  # noqa: S101  (in_scene_units)
        return scene.replace(depths=_Deeper(scene.depths, factor))

    return change


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


def _turned(degrees: float, *, tracks: bool = True) -> Fault:
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
        return scene.replace(images=tuple(images), tracks=scene.tracks if tracks else None)

    return change


if __name__ == "__main__":
    main(tyro.cli(Options))
