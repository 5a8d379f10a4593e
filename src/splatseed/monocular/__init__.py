"""Depth maps of a scene's photographs by a pretrained network.

``splatseed.monocular.network.load_network`` takes a network that is on this machine, and
``estimate_depths`` runs it on every photograph. Promise: nothing is downloaded; every photograph is
read to its last byte before the network runs on the first; the folder of maps appears whole or not
at all.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8
from PIL import Image as PilImage

from splatseed.depthmap import ASPECT_SLACK
from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.depth_maps import depth_folder
from splatseed.io.photograph import (
    check_photograph,
    decode_photograph,
    photograph_bytes,
    photograph_folder,
)
from splatseed.io.staging import check_output
from splatseed.progress import Progress, silent
from splatseed.scene import Scene

if TYPE_CHECKING:  # PyTorch is imported only where a network is loaded
    from splatseed.monocular.network import DepthNetwork

__all__ = ["DepthReport", "estimate_depths"]

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
    if max_size < 1:
        raise ParameterError("--max-size of 1 or more", found=f"{max_size}", fix="Raise it.")
    folder = photograph_folder(scene)
    protect = (folder,) if scene.source is None else scene.source.inputs
    check_output(output, kind="depth", overwrite=overwrite, protect=protect)
    sizes = _sizes(scene, folder, max_size, progress)
    start, flat = time.perf_counter(), []
    with depth_folder(
        output, network.meaning.kind, overwrite=overwrite, protect=protect, provenance=provenance
    ) as writer:
        progress("predict depth", 0.0)
        for done, (name, size) in enumerate(sizes.items(), 1):
            values = network(_load(folder / name, size))
            finite = np.isfinite(values)
            writer.write(name, np.where(finite, values, np.float32(np.nan)))
            if not finite.any() or np.ptp(values[finite]) == 0:
                flat.append(name)
            progress("predict depth", done / len(sizes))
    ordered = sorted(sizes.values(), key=lambda size: size[0] * size[1])
    seconds = time.perf_counter() - start
    return DepthReport(output, len(sizes), (ordered[0], ordered[-1]), tuple(flat), seconds)


def _sizes(scene: Scene, folder: Path, max_size: int, progress: Progress) -> dict[str, Size]:
    """The size at which the network sees each photograph, by name, in order of names."""
    lenses = {image.name: image.intrinsics for image in scene.images}
    sizes = {}
    with ThreadPoolExecutor() as pool:  # Pillow decodes outside the GIL
        checked = pool.map(lambda name: check_photograph(folder / name), sorted(lenses))
        for name, (width, height) in zip(sorted(lenses), checked, strict=True):
            lens = lenses[name]
            if abs(width / height / (lens.width / lens.height) - 1) > ASPECT_SLACK:
                raise SceneFormatError(
                    f"{folder / name} to have its camera's aspect ratio, "
                    f"{lens.width} x {lens.height}",
                    found=f"{width} x {height}",
                    fix="Use the images that the model was made from, or a resized copy of them.",
                )
            factor = min(max_size / max(width, height), 1.0)
            sizes[name] = max(round(width * factor), 1), max(round(height * factor), 1)
            progress("check images", len(sizes) / len(lenses))
    return sizes


def _load(path: Path, size: Size) -> UInt8[np.ndarray, "H W 3"]:
    picture = decode_photograph(path, photograph_bytes(path))
    if picture.size != size:
        picture = picture.resize(size, PilImage.Resampling.BICUBIC)
    return np.array(picture)
