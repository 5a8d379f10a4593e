"""Real captures at full size: time, memory and stages of every command that one meets in order.

``corridor`` (146 photographs of 1,920 x 1,440 with a phone's poses, no points) and ``plush`` (97 of
1,800 x 1,350 with COLMAP's). Each command runs in a process of its own, on all cores. Results are
kept in a file, so that stages can be measured again one by one. Prints Markdown; see README.md.

    python -m benchmarks.real_size                              # everything
    python -m benchmarks.real_size --first 12                   # a try
    python -m benchmarks.real_size --scenes plush --stages auto dense
    python -m benchmarks.real_size --stages                     # only the tables
"""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.common.children import call
from benchmarks.common.clouds import find_scenes
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.common.skipping import or_skip
from benchmarks.common.stages import StageWatch
from splatseed.errors import SceneNotFoundError, SplatseedError
from splatseed.io import load_scene, write_scene
from splatseed.io.staging import write_json
from splatseed.scene import Scene

__all__: list[str] = []

SCENES = ("corridor", "plush")
SIDES = {"train_800": 800, "train_1600": 1600}
"""Stages that time a training step: maximum pixels on a photograph's longer side."""
STAGES = ("info", "sfm", "refine", "auto", "dense", "depth", "write", *SIDES)
BUDGET = 1_000_000
STEP_VIEWS, STEPS = 8, 20
"""Photographs that training steps show, evenly spaced over the capture, and steps timed."""
MIN_SHARE = 0.03
"""Stages of a command that take less are summed up."""
NUMBER = re.compile(r"\d+")


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    scenes: tuple[str, ...] = SCENES
    """Captures, by their names in the folder of captures."""
    stages: tuple[str, ...] = STAGES
    """Which of info, sfm, refine, auto, dense, depth, write, train_800 and train_1600; depth and
    the seeds of a capture without points use the outcome of refine, write and training that of
    dense."""
    first: int | None = None
    """Use only the first n photographs."""
    work: Path = Path("real_size")
    """Folder of outputs and results."""


@dataclass(frozen=True)
class Capture:
    """A capture, and the folders of what is made of it.

    Args:
        path: The scene.
        photographs: A folder with nothing but its photographs.
        work: The folder of outputs.
        posed: The scene to seed: the capture, or at refined poses with points if it has no points.
    """

    path: Path
    photographs: Path
    work: Path
    posed: Path

    def commands(self) -> Mapping[str, Sequence[str | Path]]:
        """Return the arguments of ``splatseed`` by stage."""
        out, photographs = self.work, self.photographs
        refine = ["--poses-from", self.path, "--refine-poses"]
        return {
            "info": ["info", self.path],
            "sfm": ["sfm", photographs, "-o", out / "sfm"],
            "refine": ["sfm", photographs, *refine, "-o", out / "refine"],
            "auto": ["upsample", self.posed, "-o", out / "auto"],
            "dense": ["upsample", self.posed, "--budget", f"{BUDGET}", "-o", out / "dense"],
            "depth": ["depth", self.posed, "-o", out / "depth"],
        }


def prepare(name: str, settings: Settings) -> Capture:
    """Find a capture, or make one of its first photographs.

    Raises:
        SceneNotFoundError: It is not on this machine.
    """
    whole = find_scenes() / name
    if not whole.is_dir():
        raise SceneNotFoundError(
            f"the capture {name}", found=f"none at {whole}", fix="Set SPLATSEED_SCENES."
        )
    work = settings.work.resolve() / (
        name if settings.first is None else f"{name}_{settings.first}"
    )
    work.mkdir(parents=True, exist_ok=True)
    scene = load_scene(whole, require_points=False)
    images = sorted(scene.images, key=lambda image: image.name)[: settings.first]
    names = [image.name for image in images]
    path, has_points = whole, bool(len(scene.points))
    if settings.first is not None:
        path = work / "capture"
        if has_points:
            write_scene(scene.replace(images=tuple(images), tracks=None), path, overwrite=True)
        else:
            _link_frames(whole, names, path)
    photographs = work / "photographs"
    if not photographs.is_dir():
        photographs.mkdir()
        for each in names:
            (photographs / each).symlink_to((_image_folder(scene) / each).resolve())
    return Capture(path, photographs, work, path if has_points else work / "refine")


def _image_folder(scene: Scene) -> Path:
    folder = scene.source.image_dir
    if folder is None:
        raise SceneNotFoundError("photographs", found="none", fix="Choose another capture.")
    return folder


def _link_frames(whole: Path, names: Sequence[str], path: Path) -> None:
    """Link the files of some frames of an app's export, and those without a number."""
    path.mkdir(exist_ok=True)
    numbers = {NUMBER.findall(name)[-1] for name in names}
    for file in whole.iterdir():
        found = NUMBER.findall(file.name)
        link = path / file.name
        if (not found or found[-1] in numbers) and not link.exists():
            link.symlink_to(file.resolve())


def measure(stage: str, capture: Capture) -> dict[str, Any]:
    """Run a stage in a process of its own; return its parts and what it made."""
    threads = os.cpu_count() or 1
    if stage in SIDES:
        return _training_step(capture.work / "dense", SIDES[stage], threads)
    if stage == "write":
        given = {"scene": str(_made(capture.work / "dense")), "output": str(capture.work / "write")}
        parts = call("benchmarks.real_size:write", threads=threads, **given)
        return {"parts": parts}
    words = [str(word) for word in capture.commands()[stage]]
    output = capture.work / stage
    shutil.rmtree(output, ignore_errors=True)
    _made(Path(words[1]))
    parts = call("benchmarks.common.stages:run_command", threads=threads, arguments=words)
    return {"parts": parts, "made": _describe_output(stage, output)}


def _made(path: Path) -> Path:
    """Return the path of an earlier stage's output, if it is there."""
    if not path.is_dir():
        raise SceneNotFoundError(
            f"the outcome of stage {path.name}", found="none", fix=f"Add {path.name} to --stages."
        )
    return path


def _describe_output(stage: str, output: Path) -> str:
    """Return what a command made, for the table."""
    if stage == "info":
        return ""
    if stage == "depth":
        return f"{len(list(output.glob('*.npy'))):,} maps"
    made = load_scene(output, require_points=False)
    if stage in ("sfm", "refine"):
        return f"{len(made.images):,} poses, {len(made.points):,} points"
    return f"{len(made.points):,} points"


def write(scene: str, output: str) -> list[dict[str, Any]]:
    """Read a scene, and write it in both layouts with its photographs; in a process of its own."""
    watch = StageWatch()
    watch.begin("read")
    read = load_scene(Path(scene))
    for layout in ("colmap", "transforms"):
        watch.begin(layout)
        write_scene(read, Path(output) / layout, format=layout, copy_images=True, overwrite=True)
    return [asdict(stage) for stage in watch.stages()]


def _training_step(seeds: Path, side: int, threads: int) -> dict[str, Any]:
    """Time a training step from at most one seed per pixel."""
    from benchmarks.rendering.splats import Workload  # noqa: PLC0415  (PyTorch)
    from splatseed.photos.loading import load_views  # noqa: PLC0415
    from splatseed.photos.sizes import factor_for_size  # noqa: PLC0415
    from splatseed.splat.from_seeds import initial_gaussians  # noqa: PLC0415
    from splatseed.training.seeds import usable_seeds  # noqa: PLC0415
    from splatseed.training.settings import TrainSettings  # noqa: PLC0415

    scene = load_scene(_made(seeds))
    images = scene.split()[0]
    shown = [images[i] for i in np.linspace(0, len(images) - 1, STEP_VIEWS).round().astype(int)]
    factor = factor_for_size(images, side)
    views = load_views(scene, shown, data_factor=factor)
    width, height = views[0].width, views[0].height
    settings = TrainSettings(strategy="none", cap_max=min(width * height, BUDGET))
    points = usable_seeds(scene.points, settings, lambda _: None, views)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "workload.npz"
        Workload(initial_gaussians(points), tuple(views)).save(path)
        found = call(
            "benchmarks.rendering.train_step:measure", threads=threads, path=str(path),
            steps=STEPS, clock="wall",
        )  # fmt: skip
    laps, names = found["laps"], list(found["laps"][0])
    medians = {name: float(np.median([lap[name] for lap in laps])) for name in names}
    return {
        "step": medians,
        "peak": found["peak"],
        "made": f"{width} x {height}, {len(points):,} Gaussians",
    }


def totals(results: Mapping[str, Mapping[str, Any]]) -> Iterator[list[str]]:
    """Yield a row per capture and stage: seconds, CPU seconds, peak memory, outcome."""
    for key, result in _ordered(results):
        if "parts" in result:
            parts = result["parts"]
            seconds, processor = (sum(each[n] for each in parts) for n in ("seconds", "processor"))
            peak = max(each["peak"] for each in parts)
            numbers = [f"{seconds:.1f}", f"{processor:.1f}"]
        else:
            peak = result["peak"]
            numbers = [f"{result['step']['whole']:.2f} per step", ""]
        yield [*key.split("/"), *numbers, f"{peak / 1e9:.2f}", result.get("made", "")]


def shares(results: Mapping[str, Mapping[str, Any]]) -> Iterator[list[str]]:
    """Yield a row per capture and stage: its parts by their share of the seconds."""
    for key, result in _ordered(results):
        parts = {each["name"]: each["seconds"] for each in result.get("parts", ())}
        parts = parts or {k: v for k, v in result["step"].items() if k != "whole"}
        whole = sum(parts.values())
        big = {name: value for name, value in parts.items() if value >= MIN_SHARE * whole}
        shown = [f"{name} {value / whole:.0%}" for name, value in big.items()]
        rest = 1 - sum(big.values()) / whole
        yield [*key.split("/"), ", ".join([*shown, *[f"others {rest:.0%}"] * (rest >= 0.005)])]


def _ordered(results: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, Mapping[str, Any]]]:
    """Return results by capture, in the order of the stages."""

    def place(item: tuple[str, Any]) -> tuple[str, int]:
        name, stage = item[0].split("/")
        return name, STAGES.index(stage)

    return sorted(results.items(), key=place)


def run_stages(name: str, settings: Settings, results: dict[str, Any], kept: Path) -> None:
    """Measure the stages of a capture, and keep each result as soon as it is known."""
    capture = prepare(name, settings)
    for stage in (each for each in STAGES if each in settings.stages):

        def one(stage: str = stage) -> None:
            print(f"{capture.work.name}, {stage} ...", flush=True)
            results[f"{capture.work.name}/{stage}"] = measure(stage, capture)
            write_json(kept, results)

        or_skip(f"{capture.work.name}, {stage}", one)


def main(settings: Settings) -> None:
    """Measure the chosen stages, and print the tables of all results so far."""
    warn_if_busy()
    settings.work.mkdir(parents=True, exist_ok=True)
    kept = settings.work / "results.json"
    results: dict[str, Any] = json.loads(kept.read_text("utf-8")) if kept.is_file() else {}
    for name in settings.scenes if settings.stages else ():
        or_skip(name, lambda name=name: run_stages(name, settings, results, kept))
    header = ["capture", "stage"]
    print(f"\n{describe()}\n")
    print(table([*header, "s", "CPU s", "peak GB", "outcome"], totals(results)))
    print(f"\n{table([*header, 'share of the seconds'], shares(results))}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
