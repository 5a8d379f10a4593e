"""Load the point clouds of ``splatseed upsample --cloud`` into the scene's frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.commands.upsample.options import Options
from splatseed.findings import Finding
from splatseed.io.clouds import open_cloud
from splatseed.io.nerfstudio import read_cloud_transform
from splatseed.io.origin import find_shift
from splatseed.io.staging import add_files, write_json
from splatseed.progress import Progress
from splatseed.runtime.memory import format_bytes
from splatseed.scene import Scene
from splatseed.similarity import Similarity
from splatseed.text import visible

if TYPE_CHECKING:  # Numba comes with them
    from splatseed.seeding.clouds.align import CloudAlignment
    from splatseed.seeding.clouds.method import Cloud, GivenClouds

ALIGNMENT = "alignment.json", "preview_alignment.png"
SAMPLE = 10_000
"""Points read from a file to tell whether its coordinates include the scene's offset."""
CLOSE = 0.01
"""Residual at the middle of the picture's colour scale, relative to the cloud's extent."""


class LoadedCloud(NamedTuple):
    """A scene, and the method ``cloud`` whose files are in the scene's frame."""

    scene: Scene
    method: GivenClouds
    memory_note: str = ""
    alignment: CloudAlignment | None = None

    @property
    def findings(self) -> tuple[Finding, ...]:
        """How well the cloud is aligned, if that was computed."""
        return () if self.alignment is None else (self.alignment.finding,)

    def write(self, folder: Path) -> None:
        """Write the alignment's report and picture into the scene folder, if there is one."""
        if (found := self.alignment) is not None:
            from splatseed.viewer.clouds import preview_alignment

            add_files(folder, ALIGNMENT)
            report, picture = (folder / name for name in ALIGNMENT)
            write_json(report, found.report)
            off = found.residuals / (2 * CLOSE * found.extent)
            preview_alignment(self.scene, found.sample, found.rgb, found.tie_points, off, picture)


def load_cloud(options: Options, scene: Scene, method: Cloud, progress: Progress) -> LoadedCloud:
    """Find the transform of the clouds into the scene's frame, and configure the method with it."""
    files, memory = options.cloud_files, options.memory_bytes
    plan = method.of(*files, memory=memory).plan(scene)
    limit = f"at most {plan.capacity:,} voxels, {format_bytes(plan.memory)} of memory"
    memory_note = f"\n  -> {', '.join(visible(path) for path in files)}: {limit}"
    transform = alignment = None
    if options.cloud_transform is not None:
        transform = read_cloud_transform(options.cloud_transform, scene)
        transform = transform.then(Similarity(1.0, np.eye(3), -scene.origin))
    elif not options.align and (shift := find_shift(scene, _sample(files))).any():
        transform = Similarity(1.0, np.eye(3), shift)
    if options.align:
        from splatseed.seeding.clouds.align import align_cloud

        alignment = align_cloud(scene, files, progress)
        transform = alignment.scene_from_cloud
    given = method.of(*files, transform=transform, memory=memory)
    return LoadedCloud(scene, given, memory_note, alignment)


def _sample(files: Sequence[Path]) -> Float64[np.ndarray, "N 3"]:
    """Return the finite ones among the first points of each file."""
    firsts = (next(iter(open_cloud(file).chunks(SAMPLE)), None) for file in files)
    return np.concatenate([np.empty((0, 3)), *(c.xyz[c.finite] for c in firsts if c is not None)])
