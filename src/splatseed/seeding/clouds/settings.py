"""Settings and inputs of the method ``cloud``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

from splatseed.settings import Range
from splatseed.similarity import Similarity


@dataclass(frozen=True)
class CloudSettings:
    """The options of the method."""

    pixels: Annotated[float, Range(0.25, 64)] = 2.0
    """Side of the voxels that merge points, in pixels of the closest photograph."""
    recolor: bool = False
    """Take colours from the photographs even if the cloud has some."""
    clean: bool = True
    """Leave out points that the photographs contradict, and isolated ones."""
    test_every: Annotated[int, Range(2, also=0)] = 0
    """Leave out every n-th image by name, as trainers do for testing (8); 0 = use all."""


class CloudInputs(NamedTuple):
    """The files of a call of the method."""

    paths: tuple[Path, ...]  # in one frame
    scene_from_cloud: Similarity | None
    capacity: int  # maximum number of voxels
    alone: bool  # whether no other method adds points; if so, a note may suggest one
