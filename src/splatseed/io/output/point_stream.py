"""Points that are appended to a written scene a piece at a time: more than memory holds.

Promise: the files are, byte for byte, those of the same points in memory.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.io.colmap.binary import point_rows, set_point_count
from splatseed.io.output.seeds_npz import SEEDS, PositionDigest, write_origins
from splatseed.io.ply import ply_header, ply_rows
from splatseed.pointcloud import ORIGINAL, PointCloud

Piece = tuple[Float32[np.ndarray, "n 3"], UInt8[np.ndarray, "n 3"]]


@dataclass(frozen=True)
class PointStream:
    """Points that follow those of a scene.

    Args:
        num_original: How many of them come from the input; they come first.
        num_new: How many were made.
        code: ``PointCloud.source`` of the new ones.
        pieces: Gives positions and colours, in order.
        files: The input's files, which the output must stay apart from.
        left_out: Rows of the input that are not finite, and that repeat a position.
    """

    num_original: int
    num_new: int
    code: int
    pieces: Callable[[], Iterator[Piece]]
    files: tuple[Path, ...] = ()
    left_out: tuple[int, int] = (0, 0)

    def __len__(self) -> int:
        return self.num_original + self.num_new


def append_points(folder: Path, first: PointCloud, stream: PointStream) -> None:
    """Append points to the point files of a scene that was written without them.

    Args:
        folder: The scene, in either layout.
        first: The points that it was written with.
        stream: The others.

    Raises:
        OSError: The disk is full.
    """
    total, digest = len(first) + len(stream), PositionDigest()
    transforms = folder / "sparse_pc.ply"
    model = folder / "sparse" / "0" / "points3D.bin"
    ply = transforms if transforms.exists() else model.with_suffix(".ply")
    digest.add(first.xyz)
    with ExitStack() as files:
        rows = files.enter_context(ply.open("wb"))
        rows.write(ply_header(total))
        rows.write(ply_rows(first.xyz, first.rgb))
        records: BinaryIO | None = None
        if model.exists():
            set_point_count(model, total)
            records = files.enter_context(model.open("ab"))
        written = len(first)
        for xyz, rgb in stream.pieces():
            digest.add(xyz)
            rows.write(ply_rows(xyz, rgb))
            if records is not None:
                records.write(point_rows(written + 1, xyz, rgb))
            written += len(xyz)
    assert written == total  # noqa: S101  (the headers say so)
    if ply == transforms:
        shutil.copyfile(ply, folder / "pointcloud.ply")
    (folder / SEEDS).unlink(missing_ok=True)
    runs = [(ORIGINAL, len(first) + stream.num_original), (stream.code, stream.num_new)]
    write_origins(folder, digest.bytes(), runs)
