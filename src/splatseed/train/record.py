"""What a run records: the scene and the settings it began with, and its curve.

Notation: records are taken at regular steps. Promise: a run is never resumed with other settings,
seeds or poses than it began with; the curve's files appear whole or not at all, so that a run can
be watched while it trains.
"""

from __future__ import annotations

import csv
import dataclasses
import platform
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io import load_scene
from splatseed.io.seeds import was_upsampled
from splatseed.io.staging import atomic_file
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.train.folder import RunFolder
from splatseed.train.seeds import seeds_digest
from splatseed.train.settings import AS_IT_IS, Reading, TrainSettings

OPTIONS = {"seeding": "seeds", "cap_max": "budget"}
"""Command-line names of settings, where they differ."""


def make_config(
    scene: Scene,
    seeds: PointCloud,
    settings: TrainSettings,
    device: str,
    reading: Reading = AS_IT_IS,
) -> dict[str, Any]:
    """The content of config.json."""
    source = scene.source
    points = source.points_path if source and not reading.refine_poses else None
    return {
        "splatseed": _version("splatseed"),
        "scene": str(source.root.resolve()) if source else None,
        "points": str(points.resolve()) if points else None,
        **dataclasses.asdict(reading),
        **dataclasses.asdict(settings),
        "device": device,
        "seeds": {"count": len(seeds), "digest": seeds_digest(seeds)},
        "versions": {
            "python": platform.python_version(),
            **{name: _version(name) for name in ("torch", "gsplat", "numba", "numpy")},
        },
    }


def resumed_settings(begun: Mapping[str, Any], asked: TrainSettings) -> TrainSettings:
    """The settings of a resumed run.

    Args:
        begun: The run's config.
        asked: The user's settings; those at their defaults take the run's values, but for the
            backend, which may change.

    Raises:
        ParameterError: A setting is neither the run's nor the default.
        SceneFormatError: The config is no run's.
    """
    changes = {}
    for field in dataclasses.fields(TrainSettings):
        name, now = field.name, getattr(asked, field.name)
        if name == "backend":
            continue
        changes[name] = then = begun.get(name, field.default)  # an older run may lack a setting
        if now not in (then, field.default):
            raise ParameterError(
                f"--{OPTIONS.get(name, name.replace('_', '-'))} {then}, as when the run began",
                found=f"{now}",
                fix="Leave the option out to resume, or start again with --overwrite.",
            )
    try:
        return dataclasses.replace(asked, **changes)
    except TypeError:
        raise SceneFormatError(
            "the settings of a run in the config.json of the run",
            found="a text instead of a number",
            fix="Start again with --overwrite.",
        ) from None


def resumed_reading(begun: Mapping[str, Any], asked: Reading) -> Reading:
    """How a resumed run reads its scene.

    Args:
        begun: The run's config.
        asked: What the user asks for; what is left out is as the run has it.

    Raises:
        ParameterError: The run began otherwise.
    """
    then = {name: begun.get(name) is True for name in dataclasses.asdict(asked)}
    for name, now in dataclasses.asdict(asked).items():
        if now and not then[name]:
            raise ParameterError(
                f"no --{name.replace('_', '-')}, as when the run began",
                found="it",
                fix="Leave the option out to resume, or start again with --overwrite.",
            )
    return Reading(**then)


def check_same_seeds(path: Path, begun: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to resume from other points.

    Raises:
        ParameterError: The scene's points are not those that the run began with.
    """
    if begun.get("seeds") != now["seeds"]:
        raise ParameterError(
            f"the scene that the run began with ({begun.get('scene')}, says {path})",
            found=f"other points in {now['scene']}",
            fix="Name that scene, or start again with --overwrite.",
        )


def scene_as_read(
    scene: Scene,
    reading: Reading,
    begun: RunFolder | None,
    seed: int,
    note: Callable[[str], None],
    progress: Progress,
) -> Scene:
    """The scene, at refined poses if that is asked for.

    Args:
        scene: The scene as the user names it.
        reading: What is asked for.
        begun: The folder of the run that is resumed, if one is: it keeps refined poses.
        seed: Seed of every random choice.
        note: Called with what was done, in a sentence.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: Refined poses would replace seeds, or the resumed run began with another
            scene.
        SceneNotFoundError: There are no photographs, or the run has lost its refined poses.
        SceneFormatError: The run's refined poses are damaged.
        ReconstructionError: The poses drifted, or no point could be triangulated.
        MissingDependencyError: pycolmap is absent.
    """
    if not reading.refine_poses:
        return scene
    from splatseed.sfm import refined, with_refined  # noqa: PLC0415  (loads with its use)

    if begun is not None:
        found = load_scene(begun.scene)
        if {image.name for image in scene.images} != {image.name for image in found.images}:
            where = scene.source.root if scene.source else "the scene"
            raise ParameterError(
                f"the scene that the run began with ({begun.read_config().get('scene')}, says "
                f"{begun.config})",
                found=f"other images in {where}",
                fix="Name that scene, or start again with --overwrite.",
            )
        return with_refined(scene, found)
    if was_upsampled(scene):
        raise ParameterError(
            "a scene that splatseed has not added points to, with --refine-poses",
            found="seeds, which triangulated points would replace",
            fix="Name the scene that they were made from, or refine before seeds are made: "
            "splatseed upsample SCENE --refine-poses -o OUT.",
        )
    scene, told = refined(scene, seed, progress)
    note(told)
    return scene


def _version(package: str) -> str | None:
    """None for a package that is run from its source tree."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


class Record(NamedTuple):
    """The progress of a run."""

    step: int
    """Steps done."""
    seconds: float
    """Seconds of training alone: not of reading, scoring or writing."""
    loss: float
    """Mean since the last record."""
    train_psnr: float
    """PSNR of the last training photograph, dB."""
    test_psnr: float | None
    """Mean over the test views, dB; None if not evaluated."""
    num_gaussians: int
    test_ssim: float | None = None
    """Mean over the test views; None where it was not taken."""


def write_curve_csv(path: Path, records: Sequence[Record]) -> None:
    """Write one row per record, with a header; a PSNR not taken is left blank.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Record._fields)
        writer.writerows(records)


def write_curve_png(path: Path, records: Sequence[Record]) -> None:
    """Draw loss, PSNR and number of Gaussians over the steps, one below the other.

    Raises:
        OutputError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  (slow to import)
    from matplotlib.figure import Figure  # noqa: PLC0415  (loads with its use)

    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    losses, psnrs, counts = figure.subplots(3, 1, sharex=True)
    steps = [r.step for r in records]
    losses.semilogy(steps, [r.loss for r in records], color="C3")
    losses.set_ylabel("loss")
    shown = [r.train_psnr for r in records]
    psnrs.plot(steps, shown, color="C0", alpha=0.35, label="training, single photographs")
    tested = [(r.step, r.test_psnr) for r in records if r.test_psnr is not None]
    psnrs.plot(*zip(*tested, strict=True), "o-", color="C0", label="test, mean")
    psnrs.set_ylabel("PSNR, dB")
    psnrs.legend(loc="lower right")
    counts.plot(steps, [r.num_gaussians for r in records], color="C2")
    counts.set_ylim(bottom=0)
    counts.set_ylabel("Gaussians")
    counts.set_xlabel("step")
    counts.yaxis.set_major_formatter("{x:,.0f}")
    for axes in (losses, psnrs, counts):
        axes.grid(visible=True, which="both", alpha=0.3)
    with atomic_file(path) as partial:
        figure.savefig(partial, dpi=100)


class Board:
    """A log for TensorBoard, an optional package.

    Args:
        path: The folder of the log.
        step: Where the run resumes; entries of an interrupted run beyond it are dropped.

    Raises:
        MissingDependencyError: TensorBoard is not installed.
    """

    def __init__(self, path: Path, step: int) -> None:
        require("tensorboard")
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  (optional)

        self._writer = SummaryWriter(str(path), purge_step=step + 1)
        self.close = self._writer.close

    def add(self, record: Record) -> None:
        """Log a record."""
        scalars = {
            "loss": record.loss,
            "psnr/train": record.train_psnr,
            "psnr/test": record.test_psnr,
            "gaussians": record.num_gaussians,
            "seconds": record.seconds,
        }
        for name, value in scalars.items():
            if value is not None:
                self._writer.add_scalar(name, value, record.step)
