"""The method ``cloud``: its settings, and the files that it takes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from splatseed.errors import ParameterError
from splatseed.methods.contract import Traits
from splatseed.pointcloud import PointCloud
from splatseed.progress import Note, Progress, silent_note
from splatseed.scene import Scene
from splatseed.seeding.clouds.settings import CloudInputs, CloudSettings, MemoryPlan, plan_memory
from splatseed.seeding.photo_methods import frames_of
from splatseed.settings import check_settings
from splatseed.similarity import Similarity


@dataclass(frozen=True)
class Cloud(CloudSettings):
    """Seeds from scans and dense clouds (--cloud), as many as the photographs resolve."""

    name: ClassVar[str] = "cloud"
    traits: ClassVar[Traits] = Traits(frozenset({"cloud"}), chooses_number=True)

    def __post_init__(self) -> None:
        check_settings(self, self.name)

    def of(
        self, *files: Path | str, transform: Similarity | None = None, memory: int | None = None
    ) -> GivenClouds:
        """Return the method for files in one frame.

        Args:
            files: The clouds.
            transform: From their frame to the scene's; the same frame by default.
            memory: Maximum bytes, 4 GB by default; voxels are enlarged to fit.
        """
        paths = tuple(map(str, files))
        return GivenClouds(**vars(self), files=paths, transform=transform, memory=memory)

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> PointCloud:
        """Raise, as there are no files: ``of`` adds them."""
        raise ParameterError(
            "`cloud=FILE` for the method cloud", found="none", fix="Name the scan."
        )


@dataclass(frozen=True)
class GivenClouds(Cloud):
    """The method with its files; ``Cloud.of`` makes it."""

    files: tuple[str, ...] = ()
    transform: Similarity | None = None  # from their frame to the scene's
    memory: int | None = None  # maximum bytes
    alone: bool = True  # whether no other method adds points; if so, a note may suggest one

    def plan(self, scene: Scene) -> MemoryPlan:
        """Compute the memory that the method will take for a scene.

        Raises:
            ParameterError: The scene has no cameras, or the memory is not enough.
        """
        if not scene.images:
            raise ParameterError(
                "a scene with cameras, which choose among the points of a cloud",
                found="none",
                fix="Pass the scene of the photographs, or for a cloud alone `method='mls'`.",
            )
        return plan_memory(self.memory, frames_of(scene))

    def __call__(
        self,
        scene: Scene,
        num_new: int,
        rng: np.random.Generator,
        progress: Progress,
        note: Note = silent_note,
    ) -> PointCloud:
        """Make the seeds."""
        from splatseed.seeding.clouds.seeds import cloud_seeds

        paths, capacity = tuple(map(Path, self.files)), self.plan(scene).capacity
        inputs = CloudInputs(paths, self.transform, capacity, self.alone)
        return cloud_seeds(scene, self, inputs, rng, progress, note)
