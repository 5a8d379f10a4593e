"""Predicting and storing a depth map for every photograph of a scene.

Promise: every photograph is read to its last byte before the network runs on the first; one batch
is in memory at a time; the folder of maps appears whole or not at all.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image as PilImage

from splatseed.depthmap import ASPECT_SLACK
from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.depth.folder import depth_folder
from splatseed.io.output.staging import check_output
from splatseed.io.photograph import (
    check_photograph,
    decode_photograph,
    photograph_bytes,
    photograph_folder,
)
from splatseed.monocular.network import DepthNetwork
from splatseed.process.memory import check_memory
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene

BYTES_A_PIXEL = 3 + 4 * 3 + 4
"""Bytes per pixel of a photograph in a network: its colours, these as floats, and its depth."""
Size = tuple[int, int]
"""Width and height in pixels."""


@dataclass(frozen=True)
class DepthReport:
    """The result of prediction.

    Args:
        path: The folder of maps.
        num_images: How many there are.
        sizes: Width and height of the smallest and the largest map.
        flat: Images whose map is constant or has no finite value: the network failed there.
        seconds: Wall time of the predictions.
    """

    path: Path
    num_images: int
    sizes: tuple[Size, Size]
    flat: tuple[str, ...]
    seconds: float


def estimate_depths(
    scene: Scene,
    network: DepthNetwork,
    output: Path,
    *,
    batch: int = 1,
    max_size: int = 1600,
    overwrite: bool = False,
    provenance: Mapping[str, object] | None = None,
    progress: Progress = silent,
) -> DepthReport:
    """Predict a depth map for every image of a scene; ``splatseed.io.find_depths`` reads them.

    Args:
        scene: A scene with photographs.
        network: The network.
        output: The folder to write, with one float32 ``.npy`` per image.
        batch: Photographs per run of the network.
        max_size: A photograph whose longer side has more pixels is reduced to this before the
            network sees it, and its map has that size.
        overwrite: Whether an earlier folder of maps may be replaced.
        provenance: How the maps were made, for ``splatseed.json``.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: A number is out of its range.
        SceneNotFoundError: The scene has no images, or a photograph is missing.
        SceneFormatError: A photograph cannot be decoded, or differs from its camera in aspect
            ratio.
        OutputError: The folder cannot be written.
    """
    for name, number in (("batch", batch), ("max-size", max_size)):
        if number < 1:
            raise ParameterError(f"--{name} of 1 or more", found=f"{number}", fix="Raise it.")
    folder = photograph_folder(scene)
    protect = (folder,) if scene.source is None else scene.source.inputs
    check_output(output, kind="depth", overwrite=overwrite, protect=protect)
    sizes = _check_images(scene.images, folder, max_size, progress)
    _check_memory(sizes, batch)
    start, flat, done = time.perf_counter(), [], 0
    with depth_folder(
        output, network.meaning.kind, overwrite=overwrite, protect=protect, provenance=provenance
    ) as writer:
        progress("predict depth", 0.0)
        for names, size in _batches(sizes, batch):
            maps = network([_load(folder / name, size) for name in names])
            for name, values in zip(names, maps, strict=True):
                writer.write(name, np.where(np.isfinite(values), values, np.float32(np.nan)))
                flat += [name] if _is_flat(values) else []
            done += len(names)
            progress("predict depth", done / len(sizes))
    ordered = sorted(sizes.values(), key=lambda size: size[0] * size[1])
    seconds = time.perf_counter() - start
    return DepthReport(output, done, (ordered[0], ordered[-1]), tuple(sorted(flat)), seconds)


def _check_images(
    images: Sequence[Image], folder: Path, max_size: int, progress: Progress
) -> dict[str, Size]:
    """The size at which the network sees each photograph, by name, in order of names."""
    by_name = {image.name: image for image in images}
    sizes = {}
    with ThreadPoolExecutor() as pool:  # Pillow decodes outside the GIL
        checked = pool.map(lambda name: check_photograph(folder / name), sorted(by_name))
        for name, size in zip(sorted(by_name), checked, strict=True):
            _check_shape(folder / name, size, by_name[name])
            sizes[name] = _reduced(size, max_size)
            progress("check images", len(sizes) / len(by_name))
    return sizes


def _check_memory(sizes: Mapping[str, Size], batch: int) -> None:
    """Refuse a batch that does not fit into memory, whatever the network itself needs."""
    largest = max(width * height for width, height in sizes.values())
    fix = "Pass --batch {most}, or a smaller --max-size."
    what = f"photographs of {largest / 1e6:.1f} megapixels at a time"
    check_memory(min(batch, len(sizes)), largest * BYTES_A_PIXEL, what, fix=fix)


def _check_shape(path: Path, size: Size, image: Image) -> None:
    camera = (image.intrinsics.width, image.intrinsics.height)
    if abs(size[0] / size[1] / (camera[0] / camera[1]) - 1) > ASPECT_SLACK:
        raise SceneFormatError(
            f"{path} to have the aspect ratio of its camera, {camera[0]} x {camera[1]}",
            found=f"{size[0]} x {size[1]}",
            fix="Use the images that the model was made from, or a resized copy of them.",
        )


def _reduced(size: Size, max_size: int) -> Size:
    factor = min(max_size / max(size), 1.0)
    return max(round(size[0] * factor), 1), max(round(size[1] * factor), 1)


def _batches(sizes: Mapping[str, Size], batch: int) -> Iterator[tuple[list[str], Size]]:
    """Names that go through the network together, all of the same size."""
    for size, group in groupby(sorted(sizes, key=lambda name: (sizes[name], name)), sizes.get):
        names = list(group)
        for start in range(0, len(names), batch):
            yield names[start : start + batch], size or (0, 0)


def _load(path: Path, size: Size) -> UInt8[np.ndarray, "H W 3"]:
    picture = decode_photograph(path, photograph_bytes(path))
    if picture.size != size:
        picture = picture.resize(size, PilImage.Resampling.BICUBIC)
    return np.array(picture)


def _is_flat(values: Float32[np.ndarray, "H W"]) -> bool:
    finite = values[np.isfinite(values)]
    return bool(finite.size == 0 or np.ptp(finite) == 0)
