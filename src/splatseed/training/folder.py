"""Trained models on disk: the folder of a run, its curve, and files of Gaussians of any trainer.

Promise: a folder that splatseed did not write is never changed; an earlier run is replaced only on
request, and only when the new run is ready to start; the curve is written atomically, so that it
can be read while the run trains.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.io import staging, write_scene
from splatseed.io.files import read_text, special_kind
from splatseed.io.load import is_scene
from splatseed.io.masks import NONE
from splatseed.io.origin import add_offset
from splatseed.io.staging import MANIFEST, atomic_file, write_json
from splatseed.scene import Scene
from splatseed.splat.formats import RUN_FILE, unpacked_model
from splatseed.text import quoted

KIND = "train"  # in a run folder's manifest


class RunFolder:
    """The paths in a run's folder, whether or not they exist."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.json"  # the scene and the settings
        self.checkpoint = path / "checkpoint.pt"  # from which an unfinished run is resumed
        self.metrics = path / "metrics.json"  # the scores, once the run has finished
        self.gaussians = path / RUN_FILE
        self.curve_csv, self.curve_png = path / "curve.csv", path / "curve.png"
        self.renders = path / "renders"  # test views, if any, next to their photographs
        self.tensorboard = path / "tensorboard"  # its log, if requested
        self.scene = path / "scene"  # at refined poses, if the run refined them

    @property
    def is_run(self) -> bool:
        """Whether a run has started here."""
        return (self.path / MANIFEST).is_file() and self.config.is_file()

    def check(self, *, overwrite: bool, resume: bool, protect: Sequence[Path]) -> None:
        """Refuse a folder that is taken or protected; to be called before any work."""
        ended = self.metrics.is_file()
        if resume and ended:
            raise OutputError(
                f"an unfinished run to resume at {self.path}",
                found="a finished one",
                fix="See its metrics.json, or pass `overwrite=True` to train again.",
            )
        if resume and self.is_run:
            staging.check_separate(self.path, protect)
            return
        staging.check_output(
            self.path, kind=KIND, overwrite=overwrite or self.is_run, protect=protect
        )
        if self.is_run and not overwrite:
            resume_hint = (
                "" if ended else "`resume=True`, without settings that differ, to continue it, "
            )
            raise OutputError(
                f"no folder, or an empty one, at {self.path}",
                found="a finished run" if ended else "an unfinished run",
                fix=f"Pass {resume_hint}`overwrite=True` to replace it, or choose another.",
            )

    def create(
        self,
        config: Mapping[str, object],
        refined: Scene | None = None,
        offset: Float64[np.ndarray, " 3"] | None = None,
    ) -> None:
        """Create the folder with the config, replacing what ``check`` allowed to replace.

        Args:
            config: The content of config.json.
            refined: The scene at refined poses, to be written too.
            offset: The offset of the scene, and so of its Gaussians.
        """
        # The manifest first, so that a run interrupted here can be replaced.
        files = [self.config, self.checkpoint, self.metrics, self.gaussians, self.curve_csv]
        files += [self.curve_png, *([] if refined is None else [self.scene])]
        with staging.translate_write_errors(self.path):
            staging.remove(self.path)
        manifest = {"command": KIND, "version": config["splatseed"]}
        write_json(self.path / MANIFEST, {**manifest, "files": [path.name for path in files]})
        if offset is not None:
            add_offset(self.path, offset)
        if refined is not None:  # before the config, so that no run lacks it
            # COLMAP's layout keeps poses to the bit.
            write_scene(refined, self.scene, format="colmap")
        write_json(self.config, config)

    def claim(self, paths: Iterable[Path]) -> None:
        """List files in the folder's manifest as the run's, before or after they are written."""
        staging.add_files(self.path, [path.relative_to(self.path).as_posix() for path in paths])

    def read_config(self) -> dict[str, Any]:
        """Read config.json.

        Raises:
            SceneFormatError: It is no JSON object.
        """
        try:
            config = json.loads(read_text(self.config))
            found = type(config).__name__
        except (OSError, ValueError, RecursionError) as error:
            config, found = None, type(error).__name__
        if not isinstance(config, dict):
            raise SceneFormatError(
                f"{self.config} to be the config of a run",
                found=found,
                fix="Start again with `overwrite=True`.",
            )
        return config

    def scene_of(self, config: Mapping[str, Any]) -> Any:
        """Return the path of the trained scene: in this folder if poses were refined."""
        refined = config.get("refine_poses") is True
        return str(self.scene.resolve()) if refined else config.get("scene")


def model_file(path: Path) -> Path:
    """Return the file of a model's Gaussians; for a run, the file in its folder.

    Raises:
        SceneNotFoundError: There is none, or the run has not finished.
    """
    folder = RunFolder(path)
    for file in (path, folder.gaussians, unpacked_model(path)):
        if file is not None and file.is_file():
            return file
    found, fix = special_kind(path) or "nothing there", "Check the path."
    if folder.is_run:
        found = "a run that has not finished"
        fix = "Finish it: train with the same output and `resume=True`."
    elif path.is_dir() and is_scene(path):
        found, fix = "a scene", f"Train it first: splatseed train {quoted(path)} -o RUN."
    elif path.is_dir():
        found, fix = "a folder that is no run", "Name a run, or the file itself."
    raise SceneNotFoundError(
        f"{path} to be a finished run of splatseed train, or a file of Gaussians (.ply, .spz, ...)",
        found=found,
        fix=fix,
    )


def config_of(path: Path) -> Mapping[str, Any]:
    """Read the config of a run, given its folder or its file of Gaussians; empty for other files.

    ``scene`` is the trained scene (with refined poses, if the run refined them), ``masks`` are the
    masks of that scene.

    Raises:
        SceneFormatError: The config is damaged.
    """
    folder = RunFolder(path if path.is_dir() else path.parent)
    if path not in (folder.path, folder.gaussians) or not folder.is_run:
        return {}
    config = folder.read_config()
    masks = config.get("masks")
    if not isinstance(masks, str | None):
        expected = f"masks of {folder.config} to name a folder"
        raise SceneFormatError(expected, found=str(masks), fix="Train again with `overwrite=True`.")
    if config.get("refine_poses") is True and masks != NONE:
        masks = None  # the scene with refined poses was written with its masks
    return {**config, "scene": folder.scene_of(config), "masks": masks}


class Record(NamedTuple):
    """The progress of a run, taken at regular steps."""

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
    """Write one row per record, with a header; a PSNR not taken is left blank."""
    with atomic_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Record._fields)
        writer.writerows(records)


def write_curve_png(path: Path, records: Sequence[Record]) -> None:
    """Draw loss, PSNR and number of Gaussians over the steps, one below the other."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  (slow to import)
    from matplotlib.figure import Figure  # noqa: PLC0415  (loads with its use)

    figure = Figure(figsize=(7.0, 7.0))
    FigureCanvasAgg(figure)
    # Margins for labels of up to 100,000,000: a layout that is found draws all three times.
    margins = {"left": 0.16, "right": 0.98, "bottom": 0.075, "top": 0.985, "hspace": 0.06}
    losses, psnrs, counts = figure.subplots(3, 1, sharex=True, gridspec_kw=margins)
    steps = [r.step for r in records]
    losses.semilogy(steps, [r.loss for r in records], color="C3")
    losses.set_ylabel("loss")
    shown = [r.train_psnr for r in records]
    psnrs.plot(steps, shown, color="C0", alpha=0.35, label="training, single photographs")
    tested = [(r.step, r.test_psnr) for r in records if r.test_psnr is not None]
    if tested:
        psnrs.plot(*zip(*tested, strict=True), "o-", color="C0", label="test, mean")
    psnrs.set_ylabel("PSNR, dB")
    psnrs.legend(loc="lower right")
    counts.plot(steps, [r.num_gaussians for r in records], color="C2")
    counts.set(ylim=(0, None), ylabel="Gaussians", xlabel="step")
    counts.yaxis.set_major_formatter("{x:,.0f}")
    for axes in (losses, psnrs, counts):
        axes.grid(visible=True, which="both", alpha=0.3)
    with atomic_file(path) as partial:
        figure.savefig(partial, dpi=100)
