"""Load views: photographs, masks and cameras of a scene's images, at the size to use.

A smaller copy of a photograph is the mean over blocks of factor x factor pixels, rounded. Copies
are cached by the content of the original; a failure to write the cache is ignored.
"""

from __future__ import annotations

import hashlib
import math
import zipfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from PIL.Image import Resampling
from platformdirs import user_cache_path

from splatseed.camera import Camera
from splatseed.errors import OutputError, ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.downsampling import area_means, is_whole, reduced_size, reduction
from splatseed.io.files import ARCHIVE_FAILURES, StrPath, read_npy, translate_errors
from splatseed.io.photograph import (
    COPY_AGAIN,
    decode_photograph,
    open_photograph,
    photograph_bytes,
    photograph_folder,
)
from splatseed.io.photograph_checks import check_sizes
from splatseed.io.picture import WHITE
from splatseed.io.staging import atomic_file
from splatseed.lens import undistort_advice
from splatseed.photos.sizes import check_side
from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.projection import scaled
from splatseed.runtime.memory import check_memory
from splatseed.scene import BLACK, Color, Image, Scene

FILTER = "box-4"  # part of the cache's key: change it whenever downsampling changes
READERS = 4  # threads that decode photographs


def load_split(
    scene: Scene,
    *,
    data_factor: float = 1,
    test_every: int = 8,
    min_side: int = 1,
    cache_dir: Path | None = None,
    progress: Progress = silent,
) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Load the training and the test views of a scene (``Scene.split``), each sorted by name.

    There are no test views with ``test_every`` 0. The other arguments are those of ``load_views``.

    Raises:
        SceneNotFoundError: Images are missing, or too few.
        SceneFormatError: A camera has distortion, or an image cannot be used.
    """
    train, test = scene.split(test_every)
    tests = test_every != 0 or scene.listed is not None
    if not train or (not test if tests else len(train) < 2):
        parts = ", one to train on and one to test" if tests else ""
        raise SceneNotFoundError(
            f"at least two images with a pose{parts}",
            found=f"{len(train)} to train on, {len(test)} to test" if tests else f"{len(train)}",
            fix="Name a scene with more photographs, or choose another `test_every`."
            if tests and scene.listed is None
            else "Name a scene with more photographs.",
        )
    views = load_views(
        scene, (*train, *test), data_factor=data_factor, min_side=min_side, cache_dir=cache_dir,
        progress=progress,
    )  # fmt: skip
    return views[: len(train)], views[len(train) :]


def load_views(
    scene: Scene,
    images: Sequence[Image],
    *,
    data_factor: float = 1,
    min_side: int = 1,
    undistort: bool = False,
    draft: bool = False,
    cache_dir: Path | None = None,
    progress: Progress = silent,
) -> tuple[View, ...]:
    """Load the views of some of a scene's images, in their order, with the scene's masks.

    Args:
        scene: The scene.
        images: Its images to load.
        data_factor: Divide the width and height of photographs by this.
        min_side: Refuse smaller results, in pixels.
        undistort: Remove lens distortion instead of refusing it.
        draft: Decode JPEGs at about the smaller size only, several times as fast: pixels differ
            slightly.
        cache_dir: Where smaller photographs are cached; nowhere when left out.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: Together they do not fit into memory.
        SceneNotFoundError: An image or a mask is missing.
        SceneFormatError: A camera has distortion that is not removed, or an image or a mask is
            unusable.
    """
    photograph_folder(scene)  # raises if there is none
    for image in images if not undistort else ():
        refuse_distortion(image, scene.source.root)
    if images:
        sizes, factor = check_sizes(images), max(data_factor, 1)
        width, height = sizes[images[0].name]
        check_memory(
            int(sum(math.prod(size) for size in sizes.values()) / factor**2), 3,
            "pixels of photographs",
            found=f"{len(images)} of {width} x {height}, downsampled by {factor:g}",
            fix="Downsample more (`data_factor`), take fewer, or free some memory.",
        )  # fmt: skip
    views = []
    with ThreadPoolExecutor(READERS) as pool:
        for view in pool.map(
            lambda image: _load_view(image, data_factor, min_side, cache_dir, draft=draft), images
        ):
            views.append(view)
            progress("read images", len(views) / len(images))
    return tuple(views)


def refuse_distortion(
    image: Image, scene: Path | None = None, reason: str = "which Gaussians are drawn with"
) -> None:
    """Raise a SceneFormatError for an image whose camera has lens distortion.

    ``scene`` is the scene's folder, for the command in the advice; ``reason`` says what needs such
    cameras.
    """
    if image.intrinsics.has_distortion:
        raise SceneFormatError(
            f"cameras without lens distortion (PINHOLE), {reason}",
            found=f"{image.intrinsics.model} for {image.name}",
            fix=undistort_advice(scene),
        )


def _load_view(
    image: Image, data_factor: float, min_side: int, cache_dir: Path | None, *, draft: bool = False
) -> View:
    photograph = _load_draft(image.path, data_factor) if draft else None
    if photograph is None:
        photograph = load_photograph(
            image.path, data_factor, cache_dir, image.white,
            composited=image.shows_empty_space, background=image.background,
        )  # fmt: skip
    height, width = photograph.shape[:2]
    check_side(image.path, min_side, data_factor, (width, height))
    lens = image.lens
    K = scaled(lens.K, *reduction(lens.width, lens.height, data_factor))
    camera = Camera(K, width, height, image.camera.cam_from_world)
    mask, empty = image.read_mask(data_factor), image.read_empty(data_factor)
    if not lens.has_distortion:
        opacity = None if empty is None else image.read_opacity(data_factor)
        return View(image.name, photograph, camera, mask, empty, opacity)
    from splatseed.photos.undistortion import undistort  # noqa: PLC0415  (loads Numba)

    photograph, known = undistort(photograph, lens, K)
    if mask is not None:
        known &= undistort(_painted(mask), lens, K)[0][..., 0] == 255
    if empty is not None:
        empty = known & (undistort(_painted(empty), lens, K)[0][..., 0] > 0)
    return View(image.name, photograph, camera, known, empty)


def _painted(pixels: Bool[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    return np.repeat(np.where(pixels, 255, 0).astype(np.uint8)[..., None], 3, axis=2)


def _load_draft(path: Path, factor: float) -> UInt8[np.ndarray, "H W 3"] | None:
    """Decode a JPEG at about a smaller size, and downsample the rest; None for other files."""
    photograph = open_photograph(path, photograph_bytes(path))
    width, height = reduced_size(photograph.width, photograph.height, factor)
    if factor < 2 or photograph.format != "JPEG" or photograph.mode not in {"RGB", "L"}:
        return None
    check_side(path, 1, factor, (width, height))
    full = photograph.size
    photograph.draft(None, (width, height))
    scales = [small / whole for small, whole in zip(photograph.size, full, strict=True)]
    box = (0.0, 0.0, width * factor * scales[0], height * factor * scales[1])
    with translate_errors(path, "a complete image", fix=COPY_AGAIN):
        small = photograph.resize((width, height), Resampling.BOX, box)
    return np.array(small.convert("RGB"))


def load_photograph(
    path: StrPath,
    factor: float = 1,
    cache_dir: Path | None = None,
    white: int = WHITE,
    *,
    composited: bool = True,
    background: Color = BLACK,
) -> UInt8[np.ndarray, "H W 3"]:
    """Read a photograph, downsampled by ``factor``.

    Transparent pixels are ``composited`` over the background of renders, as
    ``io.photograph.decode_photograph`` has it. Smaller copies are cached in ``cache_dir``, if there
    is one.
    """
    path = Path(path)
    if factor < 1:
        raise ParameterError(
            "`data_factor` of 1 or more", found=f"{factor}", fix="Images are never enlarged."
        )
    encoded = photograph_bytes(path)
    digest = hashlib.blake2b(encoded, digest_size=16, person=FILTER.encode()).hexdigest()
    behind = "_composited" * composited + "".join(f"_{c}" for c in background if any(background))
    file_name = f"{digest}_{factor}_{white}{behind}.npz"
    kept = None if cache_dir is None or factor == 1 else cache_dir / file_name
    if kept is not None and (known := _read(kept)) is not None:
        return known
    original = decode_photograph(path, encoded, white, composited=composited, background=background)
    width, height = reduced_size(original.width, original.height, factor)
    check_side(path, 1, factor, (width, height))
    if not is_whole(factor):
        pixels = np.array(np.rint(area_means(np.array(original), factor)), np.uint8)
    elif factor > 1:
        side = int(factor)
        pixels = np.array(original.reduce(side, (0, 0, width * side, height * side)))
    else:
        pixels = np.array(original)
    if kept is not None:
        with suppress(OutputError, OSError):  # a cache that cannot be written is done without
            kept.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(kept) as partial, partial.open("wb") as file:
                np.savez(file, photograph=pixels)
    return pixels


def _read(path: Path) -> UInt8[np.ndarray, "H W 3"] | None:
    """Read a cached copy; None if unusable.

    It is not compressed: reading a PNG takes longer than decoding a JPEG of twice its size.
    """
    if not path.is_file():
        return None
    # A damaged one is made again. Not by np.load: views are read in threads.
    with (
        suppress(*ARCHIVE_FAILURES),
        zipfile.ZipFile(path) as archive,
        archive.open("photograph.npy") as file,
    ):
        return read_npy(file)
    return None


def user_cache_dir() -> Path:
    """Return the folder in which downsampled photographs are cached; it may not exist yet."""
    return user_cache_path("splatseed", appauthor=False) / "images"
