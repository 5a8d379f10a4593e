"""The folder of a run: its files, and permission to write.

Promise: a folder that splatseed did not write is never touched; an earlier run is replaced only on
request, and not before the new one is ready to start.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from splatseed.errors import OutputError, SceneFormatError
from splatseed.io import write_scene
from splatseed.io.files import read_text
from splatseed.io.staging import (
    MANIFEST,
    add_files,
    check_apart,
    check_output,
    oserror_as_output_error,
    remove,
    write_json,
)
from splatseed.scene import Scene

KIND = "train"
"""The kind recorded in a run folder's manifest."""


class RunFolder:
    """A run's folder.

    Attributes:
        path: Where it is, or will be.
        config: The scene and the settings, as JSON.
        checkpoint: The state from which an unfinished run is resumed.
        metrics: The scores, as JSON; written once the run has finished.
        gaussians: The trained Gaussians.
        curve_csv: The curve as a table.
        curve_png: The curve as a picture.
        renders: Test views beside their photographs.
        tensorboard: TensorBoard's log, if asked for.
        scene: The scene at refined poses, if the run refined them.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "config.json"
        self.checkpoint = path / "checkpoint.pt"
        self.metrics = path / "metrics.json"
        self.gaussians = path / "point_cloud.ply"
        self.curve_csv = path / "curve.csv"
        self.curve_png = path / "curve.png"
        self.renders = path / "renders"
        self.tensorboard = path / "tensorboard"
        self.scene = path / "scene"

    @property
    def is_run(self) -> bool:
        """Whether a run has begun here."""
        return (self.path / MANIFEST).is_file() and self.config.is_file()

    def check(self, *, overwrite: bool, resume: bool, protect: Sequence[Path]) -> None:
        """Refuse a folder that must not be written to, before any work is done.

        Raises:
            OutputError: It is taken or protected.
        """
        if resume and self.metrics.is_file():
            raise OutputError(
                f"an unfinished run to resume at {self.path}",
                found="a finished one",
                fix="See its metrics.json, or pass --overwrite to train again.",
            )
        if resume and self.is_run:
            check_apart(self.path, protect)
            return
        check_output(self.path, kind=KIND, overwrite=overwrite or self.is_run, protect=protect)
        if self.is_run and not overwrite:
            ended = self.metrics.is_file()
            go_on = "" if ended else "--resume, without options that differ, to continue it, "
            raise OutputError(
                f"no folder, or an empty one, at {self.path}",
                found="a finished run" if ended else "an unfinished run",
                fix=f"Pass {go_on}--overwrite to replace it, or choose another.",
            )

    def begin(self, config: Mapping[str, object], refined: Scene | None = None) -> None:
        """Make the folder, empty but for the config; removes what ``check`` allowed to replace.

        Args:
            config: What to record of the run.
            refined: The scene at refined poses, if they were refined: the folder keeps it.

        Raises:
            OutputError: It cannot be written.
        """
        # The manifest first: a run that is interrupted here can be replaced.
        files = [self.config, self.checkpoint, self.metrics, self.gaussians, self.curve_csv]
        files += [self.curve_png, *([] if refined is None else [self.scene])]
        with oserror_as_output_error(self.path):
            remove(self.path)
        manifest = {"command": KIND, "version": config["splatseed"]}
        write_json(self.path / MANIFEST, {**manifest, "files": [path.name for path in files]})
        if refined is not None:  # before the config, so that no run lacks it
            # COLMAP's layout keeps poses to the bit.
            write_scene(refined, self.scene, format="colmap")
        write_json(self.config, config)

    def claim(self, paths: Iterable[Path]) -> None:
        """List files in the folder as the run's own, before or after they are written.

        Raises:
            OutputError: The list cannot be written.
        """
        add_files(self.path, [path.relative_to(self.path).as_posix() for path in paths])

    def read_config(self) -> dict[str, Any]:
        """What ``begin`` wrote.

        Raises:
            SceneFormatError: It is no JSON object.
        """
        try:
            config = json.loads(read_text(self.config))
        except (OSError, ValueError) as error:
            raise _unreadable(self.config, type(error).__name__) from None
        if not isinstance(config, dict):
            raise _unreadable(self.config, type(config).__name__)
        return config

    def scene_of(self, config: Mapping[str, Any]) -> Any:
        """Where the scene lies that the run trained: in its folder if poses were refined.

        Args:
            config: The run's; without a scene of its own, what it says of one is passed on.
        """
        refined = config.get("refine_poses") is True
        return str(self.scene.resolve()) if refined else config.get("scene")


def _unreadable(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to be the config of a run", found=found, fix="Start again with --overwrite."
    )
