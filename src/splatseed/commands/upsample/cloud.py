"""The part of ``splatseed upsample`` that brings clouds: which files, in which frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.errors import ParameterError
from splatseed.io.cleaning import check_precision, offset_of, recentred
from splatseed.io.staging import add_files, write_json
from splatseed.io.transform_file import read_cloud_transform
from splatseed.literal import visible
from splatseed.progress import Progress
from splatseed.runtime.memory import words_of
from splatseed.scene import Scene
from splatseed.similarity import Similarity

if TYPE_CHECKING:
    from splatseed.seeding.clouds.align import CloudAlignment
    from splatseed.seeding.clouds.method import Cloud
    from splatseed.seeding.clouds.voxels import MemoryPlan

CLOUD = "cloud"
RECENTER = "recenter.json"
ALIGNMENT = "alignment.json", "preview_alignment.png"
CLOSE = 0.01
"""Residual at which a point's colour is halfway, in extents."""
WITH_CLOUD = (CLOUD, "auto", "stereo", "cover", "depth")
"""Methods that --cloud can be combined with."""


class CloudOptions(NamedTuple):
    """The options about clouds."""

    files: tuple[Path, ...] = ()
    transform: Path | None = None
    align: bool = False
    recenter: bool = False
    memory: int | None = None
    """Most bytes of memory."""

    @property
    def provenance(self) -> dict[str, object]:
        """For ``splatseed.json``."""
        return {
            "files": [str(path.resolve()) for path in self.files],
            "transform": None if self.transform is None else str(self.transform.resolve()),
            "align": self.align,
            "recenter": self.recenter,
            "memory": self.memory,
        }


def with_cloud_defaults(options: Any, arguments: Sequence[str]) -> Any:
    """The options, with what --cloud changes about those that were not named.

    Args:
        options: As they were parsed.
        arguments: The words of the command line.

    Raises:
        ParameterError: Options for a cloud without one, or that exclude each other.
    """
    given = options.cloud_files
    if not given:
        unused = options.cloud_transform is not None or options.align or options.recenter
        if unused or options.method == CLOUD:
            raise ParameterError("--cloud FILE", found="none", fix="Name the scan.")
        return options
    named = any(word.partition("=")[0] == "--method" for word in arguments)
    method = options.method if named else CLOUD
    if method not in WITH_CLOUD:
        raise ParameterError(
            f"--method {', '.join(WITH_CLOUD[:-1])} or {WITH_CLOUD[-1]} with --cloud",
            found=method,
            fix="Leave --method out for the cloud's points alone: interpolating needs no scan.",
        )
    if options.recenter and options.format == "transforms":
        raise ParameterError(
            "--format colmap with --recenter", found="transforms", fix="Leave --format out."
        )
    if options.align and options.cloud_transform is not None:
        raise ParameterError("--align or --transform", found="both", fix="Leave one of them out.")
    layout = "colmap" if options.recenter else options.format
    return dataclasses.replace(options, method=method, format=layout)


class LoadedCloud(NamedTuple):
    """A scene and the clouds for it."""

    scene: Scene
    method: Cloud
    """The method ``cloud``, with its files if there are any."""
    alignment: CloudAlignment | None = None
    offset: Float64[np.ndarray, " 3"] | None = None
    """What was subtracted from all coordinates of the scene."""
    files: tuple[Path, ...] = ()
    plan: MemoryPlan | None = None
    """What the clouds take."""

    @property
    def takes(self) -> str:
        """What the clouds take, as a line below others; empty without clouds."""
        if self.plan is None:
            return ""
        most = f"at most {self.plan.capacity:,} voxels, {words_of(self.plan.memory)} of memory"
        return f"\n  -> {', '.join(visible(path) for path in self.files)}: {most}"

    @property
    def notes(self) -> tuple[str, ...]:
        """What the user should know, one sentence each."""
        notes = () if self.alignment is None else (self.alignment.sentence,)
        if self.offset is None:
            return notes
        place = ", ".join(f"{value:.0f}" for value in self.offset)
        return (*notes, f"Scene and cloud were moved by -({place}), as {RECENTER} has it.")

    @property
    def written(self) -> tuple[str, ...]:
        """The files that ``write`` writes."""
        return (*((RECENTER,) if self.offset is not None else ()), *self.aligned)

    @property
    def aligned(self) -> tuple[str, ...]:
        """The files that tell of the alignment, if there is one."""
        return () if self.alignment is None else ALIGNMENT

    def write(self, folder: Path) -> None:
        """Write the reports beside the scene, if there are any.

        Raises:
            OutputError: One cannot be written.
        """
        if self.written:
            add_files(folder, self.written)  # or --overwrite would take them for the user's
        if self.offset is not None:
            told = {
                "offset": self.offset.tolist(),
                "meaning": "coordinates before = after + offset",
            }
            write_json(folder / RECENTER, told)
        if self.alignment is not None:
            from splatseed.view.clouds import preview_alignment  # noqa: PLC0415  (Pillow)

            alignment = self.alignment
            report, picture = (folder / name for name in ALIGNMENT)
            write_json(report, alignment.report)
            off = alignment.residuals / (2 * CLOSE * alignment.extent)
            preview_alignment(
                self.scene, alignment.sample, alignment.rgb, alignment.marks, off, picture
            )


def load_clouds(
    options: CloudOptions, scene: Scene, method: Cloud, progress: Progress
) -> LoadedCloud:
    """The scene, recentred if so asked, and the method ``cloud`` with its files in its frame.

    Raises:
        ParameterError: The scene's coordinates need recentring, or the memory is not enough.
        PointCloudError: An alignment is not sure.
        SceneNotFoundError: A file is missing.
        SceneFormatError: One is damaged.
    """
    if not options.files:
        return LoadedCloud(scene, method)
    plan = method.of(*options.files, memory=options.memory).plan(scene)
    transform = None
    if options.transform is not None:
        transform = read_cloud_transform(options.transform, scene)
    offset = None
    if options.recenter:
        offset = offset_of(scene)
        scene = recentred(scene, offset)
        moved = Similarity(1.0, np.eye(3), -offset)
        transform = moved if transform is None else transform.then(moved)
    check_precision(scene)
    alignment = None
    if options.align:
        from splatseed.seeding.clouds.align import align  # noqa: PLC0415  (loads Numba)

        alignment = align(scene, options.files, progress)
        transform = alignment.scene_from_cloud
    given = method.of(*options.files, transform=transform, memory=options.memory)
    return LoadedCloud(scene, given, alignment, offset, options.files, plan)
