"""The files of COLMAP's dense stereo: maps of floats, and consistency graphs.

Notation: layouts as COLMAP's mvs/mat.h and mvs/consistency_graph.h have them, little-endian. Both
begin with the text ``W&H&C&``. A map follows with C x H x W float32, one channel after another; a
graph with int32: column, row, n and n image indices for each pixel that has any. Writers let
``OSError`` pass: their caller stages the output.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32, UInt8


def write_map(path: Path, values: Float32[np.ndarray, "H W *C"]) -> None:
    """Write a depth map [H, W] or a normal map [H, W, 3]; NaN becomes 0, COLMAP's "unknown".

    Args:
        path: A file that does not exist yet.
        values: The map, top row first.

    Raises:
        FileExistsError: There is a file already.
    """
    height, width = values.shape[:2]
    planes = np.moveaxis(values.reshape(height, width, -1), -1, 0)
    known = np.nan_to_num(planes, nan=0.0).astype("<f4")
    _write(path, (width, height, len(planes)), known.tobytes())


def write_consistency_graph(
    path: Path, agreeing: UInt8[np.ndarray, "H W"], image_idxs: Sequence[int]
) -> None:
    """Write which images confirm each pixel.

    Args:
        path: A file that does not exist yet.
        agreeing: Bit k is set where ``image_idxs[k]`` confirms the pixel.
        image_idxs: Positions of the sources in the model's list of images, from 0.

    Raises:
        FileExistsError: There is a file already.
    """
    height, width = agreeing.shape
    records = consistency_records(agreeing, image_idxs)
    _write(path, (width, height, 1), records.astype("<i4").tobytes())


def consistency_records(
    agreeing: UInt8[np.ndarray, "H W"], image_idxs: Sequence[int]
) -> Int32[np.ndarray, " M"]:
    """Column, row, count and image indices of each pixel that has any, row by row."""
    bits = (agreeing[..., None] >> np.arange(len(image_idxs), dtype=np.uint8)) & 1
    rows, columns = np.nonzero(bits.any(axis=-1))
    bits = bits[rows, columns].astype(bool)
    counts = bits.sum(axis=1)
    starts = np.cumsum(counts + 3) - (counts + 3)
    records = np.empty(int((counts + 3).sum()), np.int32)
    for place, values in enumerate((columns, rows, counts)):
        records[starts + place] = values
    pixel, source = np.nonzero(bits)
    nth = np.arange(len(pixel)) - np.repeat(np.cumsum(counts) - counts, counts)
    records[starts[pixel] + 3 + nth] = np.array(image_idxs, np.int32)[source]
    return records


def _write(path: Path, size: tuple[int, int, int], body: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("xb") as file:
        file.write("".join(f"{each}&" for each in size).encode("ascii"))
        file.write(body)
