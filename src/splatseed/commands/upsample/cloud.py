"""The part of ``splatseed upsample`` that brings clouds: in which frame, and what is told of it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.io.clouds import open_cloud
from splatseed.io.nerfstudio import read_cloud_transform
from splatseed.io.origin import shift_to
from splatseed.io.staging import add_files, write_json
from splatseed.progress import Progress
from splatseed.runtime.memory import words_of
from splatseed.scene import Scene
from splatseed.similarity import Similarity
from splatseed.text import visible

if TYPE_CHECKING:
    from splatseed.commands.upsample.command import Options
    from splatseed.seeding.clouds.align import CloudAlignment
    from splatseed.seeding.clouds.method import Cloud, GivenClouds

ALIGNMENT = "alignment.json", "preview_alignment.png"
SAMPLE = 10_000
"""Points of a file by which it is known whether it is around the scene's offset."""
CLOSE = 0.01
"""Residual at which a point's colour is halfway, in extents."""


class LoadedCloud(NamedTuple):
    """A scene, and the method ``cloud`` with files in its frame.

    ``takes``: a line on the memory.
    """

    scene: Scene
    method: GivenClouds
    takes: str = ""
    alignment: CloudAlignment | None = None

    @property
    def notes(self) -> list[str]:
        """What the user should know, one sentence each."""
        return [] if self.alignment is None else [self.alignment.summary]

    def write(self, folder: Path) -> None:
        """Write the reports beside the scene, if there are any."""
        if (found := self.alignment) is not None:
            from splatseed.viewer.clouds import preview_alignment

            add_files(folder, ALIGNMENT)
            report, picture = (folder / name for name in ALIGNMENT)
            write_json(report, found.report)
            off = found.residuals / (2 * CLOSE * found.extent)
            preview_alignment(self.scene, found.sample, found.rgb, found.tie_points, off, picture)


def load_cloud(options: Options, scene: Scene, method: Cloud, progress: Progress) -> LoadedCloud:
    """The scene, and the method ``cloud`` with its files in its frame."""
    files, memory = options.cloud_files, options.memory_bytes
    plan = method.of(*files, memory=memory).plan(scene)
    most = f"at most {plan.capacity:,} voxels, {words_of(plan.memory)} of memory"
    takes = f"\n  -> {', '.join(visible(path) for path in files)}: {most}"
    transform = alignment = None
    if options.cloud_transform is not None:
        transform = read_cloud_transform(options.cloud_transform, scene)
        transform = transform.then(Similarity(1.0, np.eye(3), -scene.origin))
    elif not options.align and (shift := shift_to(scene, _sample(files))).any():
        transform = Similarity(1.0, np.eye(3), shift)
    if options.align:
        from splatseed.seeding.clouds.align import align

        alignment = align(scene, files, progress)
        transform = alignment.scene_from_cloud
    given = method.of(*files, transform=transform, memory=memory)
    return LoadedCloud(scene, given, takes, alignment)


def _sample(files: Sequence[Path]) -> Float64[np.ndarray, "N 3"]:
    """The first points of each file that are finite."""
    firsts = (next(iter(open_cloud(file).chunks(SAMPLE)), None) for file in files)
    return np.concatenate([np.empty((0, 3)), *(c.xyz[c.finite] for c in firsts if c is not None)])
