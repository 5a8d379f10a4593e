"""What tiles are made of: a file of points, or the originals of a scene in memory.

Promise: a source gives the points that the cloud in memory would have, in the same order; its
fingerprint changes when they may have.
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from splatseed.errors import OutputError
from splatseed.io.clouds import CloudChunk, CloudFile
from splatseed.io.seeds import number_of_originals
from splatseed.scene import Scene
from splatseed.upsample.neighbors import trusted_originals


class Source(ABC):
    """Points that may be too many for memory.

    Attributes:
        count: How many there are; None if only reading tells.
        trusted: Which of them may be bases; None if all may.
        held: Bytes that it keeps in memory.
    """

    count: int | None
    held: int = 0
    trusted: Bool[np.ndarray, " n"] | None = None

    @abstractmethod
    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """The points in order, at most ``size`` at a time."""

    @abstractmethod
    def fingerprint(self) -> dict[str, object]:
        """What tells one input from another, as JSON has it."""


@dataclass
class FileSource(Source):
    """A file of points; those that splatseed added to it before are left out.

    Args:
        cloud: The file.
    """

    cloud: CloudFile

    def __post_init__(self) -> None:
        self.count = self.cloud.count
        if self.count is not None:
            self.count = number_of_originals(self.cloud.path.parent, self.count)

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """See ``Source``."""
        left = self.count if self.count is not None else np.iinfo(np.int64).max
        for chunk in self.cloud.chunks(size):
            if left <= 0:
                return
            yield chunk if len(chunk) <= left else chunk.select(slice(0, left))
            left -= len(chunk)

    def fingerprint(self) -> dict[str, object]:
        """See ``Source``: the file's name, size and time of change."""
        path = self.cloud.path.resolve()
        known = path.stat()
        return {"path": str(path), "bytes": known.st_size, "changed": known.st_mtime_ns}


@dataclass
class SceneSource(Source):
    """The originals of a scene.

    Args:
        scene: The scene; its originals come first.
    """

    scene: Scene

    def __post_init__(self) -> None:
        self.points = self.scene.points.originals
        if self.points.attributes:
            raise OutputError(
                "originals with positions and colours only, to be written a piece at a time",
                found=f"{', '.join(self.points.attributes)} of them, in seeds.npz",
                fix="Leave out --memory and --executor, or remove seeds.npz.",
            )
        self.count = len(self.points)
        self.trusted = trusted_originals(self.scene)
        self.held = _bytes_of(self.scene)

    def chunks(self, size: int) -> Iterator[CloudChunk]:
        """See ``Source``."""
        for first in range(0, len(self.points), size):
            part = slice(first, first + size)
            yield CloudChunk(self.points.xyz[part].astype(np.float64), self.points.rgb[part])

    def fingerprint(self) -> dict[str, object]:
        """See ``Source``: a hash of the points."""
        digest = hashlib.blake2b(digest_size=16)
        trusted = np.ones(1, bool) if self.trusted is None else self.trusted
        for array in (self.points.xyz, self.points.rgb, trusted):
            digest.update(np.ascontiguousarray(array).data)
        return {"points": len(self.points), "digest": digest.hexdigest()}


def _bytes_of(scene: Scene) -> int:
    """Bytes of a scene's arrays."""
    parts = [scene.points, scene.tracks, *(image.observations for image in scene.images)]
    arrays = (value for part in parts if part is not None for value in vars(part).values())
    return sum(value.nbytes for value in arrays if isinstance(value, np.ndarray))
