"""The part of ``splatseed upsample`` that brings clouds: in which frame, and what is told of it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.io.cleaning import check_precision, offset_of, recentred
from splatseed.io.nerfstudio import read_cloud_transform
from splatseed.io.staging import add_files, write_json
from splatseed.literal import visible
from splatseed.progress import Progress
from splatseed.runtime.memory import words_of
from splatseed.scene import Scene
from splatseed.similarity import Similarity

if TYPE_CHECKING:
    from splatseed.commands.upsample.command import Options
    from splatseed.seeding.clouds.align import CloudAlignment
    from splatseed.seeding.clouds.method import Cloud, GivenClouds

RECENTER = "recenter.json"
ALIGNMENT = "alignment.json", "preview_alignment.png"
CLOSE = 0.01
"""Residual at which a point's colour is halfway, in extents."""


class LoadedCloud(NamedTuple):
    """A scene, and the method ``cloud`` with files in its frame.

    ``takes``: a line on the memory; ``offset``: what was subtracted from the scene's coordinates.
    """

    scene: Scene
    method: GivenClouds
    takes: str = ""
    alignment: CloudAlignment | None = None
    offset: Float64[np.ndarray, " 3"] | None = None

    @property
    def notes(self) -> list[str]:
        """What the user should know, one sentence each."""
        notes = [] if self.alignment is None else [self.alignment.sentence]
        if self.offset is not None:
            place = ", ".join(f"{value:.0f}" for value in self.offset)
            notes.append(f"Scene and cloud were moved by -({place}), as {RECENTER} has it.")
        return notes

    def write(self, folder: Path) -> None:
        """Write the reports beside the scene, if there are any."""
        if self.offset is not None:
            add_files(folder, [RECENTER])  # or --overwrite would take it for the user's
            meaning = "coordinates before = after + offset"
            write_json(folder / RECENTER, {"offset": self.offset.tolist(), "meaning": meaning})
        if (found := self.alignment) is not None:
            from splatseed.view.clouds import preview_alignment  # noqa: PLC0415  (Pillow)

            add_files(folder, ALIGNMENT)
            report, picture = (folder / name for name in ALIGNMENT)
            write_json(report, found.report)
            off = found.residuals / (2 * CLOSE * found.extent)
            preview_alignment(self.scene, found.sample, found.rgb, found.marks, off, picture)


def load_cloud(options: Options, scene: Scene, method: Cloud, progress: Progress) -> LoadedCloud:
    """The scene, recentred if so asked, and the method ``cloud`` with its files in its frame."""
    files, memory = options.cloud_files, options.memory_bytes
    plan = method.of(*files, memory=memory).plan(scene)
    most = f"at most {plan.capacity:,} voxels, {words_of(plan.memory)} of memory"
    takes = f"\n  -> {', '.join(visible(path) for path in files)}: {most}"
    transform = offset = alignment = None
    if options.cloud_transform is not None:
        transform = read_cloud_transform(options.cloud_transform, scene)
    if options.recenter:
        offset = offset_of(scene)
        scene = recentred(scene, offset)
        moved = Similarity(1.0, np.eye(3), -offset)
        transform = moved if transform is None else transform.then(moved)
    check_precision(scene)
    if options.align:
        from splatseed.seeding.clouds.align import align  # noqa: PLC0415  (loads Numba)

        alignment = align(scene, files, progress)
        transform = alignment.scene_from_cloud
    given = method.of(*files, transform=transform, memory=memory)
    return LoadedCloud(scene, given, takes, alignment, offset)
