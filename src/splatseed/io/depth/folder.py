"""Folders of depth maps: reading the description of their contents, and writing a folder.

Notation: ``depths.json`` beside the maps holds ``{"kind": "z" | "ray" | "inverse", "scale": S}``,
both optional: what the values are, and stored units per scene unit. Promise: a folder appears whole
or not at all, with one float32 ``.npy`` per image, named after the image.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32

from splatseed.depthmap import DepthKind
from splatseed.errors import OutputError, SceneFormatError
from splatseed.io.depth.arrays import KINDS, check_stored
from splatseed.io.files import read_bytes
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.literal import told

CAMERA_FILE = "cam_params.json"
"""The camera of an RGB-D capture, and the scale of its maps, in its folder or the one above."""
DESCRIPTION = "depths.json"
"""The file beside depth maps that describes them."""


class DepthDescription(NamedTuple):
    """What a folder says about its maps.

    Args:
        kind: What the values are; None: not said.
        scale: Stored units per scene unit; None: not said.
    """

    kind: DepthKind | None = None
    scale: float | None = None


def read_description(path: Path) -> DepthDescription:
    """Read a ``depths.json``.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no such description.
    """
    content = _read_object(path)
    kind, scale = content.get("kind"), content.get("scale")
    if kind is not None and kind not in KINDS:
        raise SceneFormatError(
            f"kind in {path} to be {', '.join(KINDS)}",
            found=repr(kind)[:80],
            fix="Correct it, or leave it out for planar z.",
        )
    return DepthDescription(kind, None if scale is None else _positive(path, scale))


def write_description(
    folder: Path, kind: DepthKind, scale: float = 1.0, **more: object
) -> DepthDescription:
    """Write a ``depths.json`` into a folder of maps.

    Args:
        folder: Where the maps are.
        kind: What the values are.
        scale: Stored units per scene unit.
        more: How they were made; for people, never read back.

    Raises:
        OSError: It cannot be written.
    """
    write_json(folder / DESCRIPTION, {"kind": kind, "scale": scale, **more})
    return DepthDescription(kind, scale)


def read_capture_scale(path: Path) -> float | None:
    """Stored units per metre that the ``cam_params.json`` of an RGB-D capture gives, if it does.

    Raises:
        SceneFormatError: It is no such file, or its scale is not a positive number.
    """
    camera = _read_object(path).get("camera")
    scale = camera.get("scale") if isinstance(camera, dict) else None
    return None if scale is None else _positive(path, scale)


def safe_parts(name: str) -> tuple[str, ...]:
    """The folders and the file name of an image, without parts that lead out of a folder."""
    pure = PurePosixPath(name)
    return tuple(part for part in pure.parts if part not in {"..", pure.anchor})


@dataclass(frozen=True)
class DepthWriter:
    """Writes the maps of a folder in the making.

    Args:
        folder: Where to.
    """

    folder: Path

    def write(self, name: str, values: Float32[np.ndarray, "H W"]) -> None:
        """Keep the map of one image; safe to call from several threads.

        Args:
            name: The image's name.
            values: NaN where nothing is known.

        Raises:
            OutputError: Two image names become the same once parts that lead out are dropped.
        """
        path = self.folder.joinpath(*safe_parts(f"{name}.npy"))
        check_stored(path, values.shape, values.dtype)
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with path.open("xb") as file:
                np.save(file, np.ascontiguousarray(values, np.float32))
        except FileExistsError:
            raise OutputError(
                "one depth map per image", found=f"two for {name}", fix="Rename the image."
            ) from None


@contextmanager
def depth_folder(
    path: Path,
    kind: DepthKind,
    *,
    overwrite: bool = False,
    protect: tuple[Path, ...] = (),
    provenance: Mapping[str, object] | None = None,
) -> Iterator[DepthWriter]:
    """A folder of depth maps that appears at ``path`` when the block ends without an error.

    Args:
        path: Where the maps should be.
        kind: What their values are.
        overwrite: Whether a folder that splatseed wrote may be replaced.
        protect: Inputs that the folder must lie apart from.
        provenance: How the maps were made, for ``splatseed.json``.

    Yields:
        The writer of the maps.

    Raises:
        OutputError: ``path`` is taken or protected, or writing failed.
    """
    with output_folder(path, kind="depth", overwrite=overwrite, protect=protect) as partial:
        yield DepthWriter(partial)
        write_description(partial, kind)
        write_json(partial / MANIFEST, dict(provenance or {}))


def _read_object(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_bytes(path).decode("utf-8"))
    except (ValueError, RecursionError) as error:
        wrong = told(error)
    else:
        if isinstance(content, dict):
            return content
        wrong = type(content).__name__
    raise SceneFormatError(f"{path} to hold a JSON object", found=wrong, fix="Write it again.")


def _positive(path: Path, scale: object) -> float:
    if isinstance(scale, int | float) and not isinstance(scale, bool):
        try:
            number = float(scale)
        except OverflowError:
            number = math.inf
        if math.isfinite(number) and number > 0:
            return number
    raise SceneFormatError(
        f"scale in {path} to be a number above 0", found=repr(scale)[:80], fix="Correct it."
    )
