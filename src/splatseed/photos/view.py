"""Views: posed photographs of pinhole cameras in memory, at the size they are used at.

A photograph is downsampled once, by a whole factor f, and never enlarged: a smaller copy is the
mean over f x f blocks, rounded (pixels at the right and lower edge that do not fill a block are cut
off), so intrinsics are divided by f and nothing else changes. Copies are kept by the content of the
original in ``cache_dir``, and a failure to write there is ignored.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from platformdirs import user_cache_path

from splatseed.camera import Camera
from splatseed.errors import OutputError, ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.bit_depth import WHITE
from splatseed.io.files import StrPath
from splatseed.io.masks import read_mask
from splatseed.io.photograph import (
    decode_photograph,
    open_photograph,
    photograph_bytes,
    photograph_folder,
)
from splatseed.io.photograph_checks import check_sizes, file_sizes, resized_to
from splatseed.io.staging import atomic_file
from splatseed.lens import undistort_first
from splatseed.progress import Progress, silent
from splatseed.runtime.memory import check_memory
from splatseed.scene import Image, Masks, Scene

TRAINED_SIDE = 1600
"""Longest side of photographs in training by default, in pixels, as graphdeco's trainer has it."""
READERS = 4  # threads that decode photographs
NEAR_PLANE = 0.01  # where nothing is known of the scene; gsplat's


@dataclass(frozen=True, eq=False)
class View:
    """A posed photograph."""

    name: str  # the image's name in its scene
    photograph: UInt8[np.ndarray, "H W 3"]  # sRGB
    K: Float64[np.ndarray, "3 3"]  # in pixels of the photograph
    width: int
    height: int
    cam_from_world: Float64[np.ndarray, "4 4"]
    mask: Bool[np.ndarray, "H W"] | None = None  # pixels that count; None: all
    near: float = NEAR_PLANE  # no Gaussian nearer than this is drawn; in the unit of the pose

    @property
    def camera(self) -> Camera:
        """Its camera."""
        return Camera(self.K, self.width, self.height, self.cam_from_world)


def view_of(camera: Image | Camera | View) -> View:
    """A camera as a view without pixels; a view as it is."""
    if isinstance(camera, View):
        return camera
    name = ""
    if isinstance(camera, Image):
        name, camera = camera.name, camera.camera
    unseen = np.empty((0, 0, 3), np.uint8)
    return View(name, unseen, camera.K, camera.width, camera.height, camera.cam_from_world)


def poses_of(images: Sequence[Image], data_factor: int = 1) -> tuple[View, ...]:
    """The views of some images without their pixels, where only their frames matter."""
    unseen, views = np.empty((0, 0, 3), np.uint8), []
    shrink = np.diag([1 / data_factor, 1 / data_factor, 1.0])
    for image in images:
        camera = image.camera
        sides = camera.width // data_factor, camera.height // data_factor
        if not min(sides):
            raise _too_small(image.name, 1, data_factor, sides)
        views.append(View(image.name, unseen, shrink @ camera.K, *sides, camera.cam_from_world))
    return tuple(views)


def at_file_size(scene: Scene) -> Scene:
    """The scene with the camera of each image in pixels of its photograph.

    Photographs may be resized copies of those that the model was made from. An image whose
    photograph is missing, cannot be read or does not fit keeps its camera.
    """
    folder = scene.source.image_dir if scene.source else None
    images = resized_to(scene.images, {} if folder is None else file_sizes(scene.images, folder))
    if all(image is before for image, before in zip(images, scene.images, strict=True)):
        return scene
    cameras = {lens.camera_id: lens for lens in scene.intrinsics}
    cameras |= {image.intrinsics.camera_id: image.intrinsics for image in images}
    return scene.replace(images=images, intrinsics=tuple(cameras.values()))


def data_factor(images: Sequence[Image], max_size: int) -> int:
    """The whole factor that makes the longest side at most ``max_size`` pixels."""
    side = max(max(image.camera.width, image.camera.height) for image in images)
    return max(1, -(-side // max_size))


def default_factor(images: Sequence[Image]) -> int:
    """The factor by which training divides photographs unless the user says otherwise."""
    return data_factor(images, TRAINED_SIDE) if images else 1


def load_split(
    scene: Scene,
    *,
    data_factor: int = 1,
    test_every: int = 8,
    min_side: int = 1,
    cache_dir: Path | None = None,
    progress: Progress = silent,
) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """The training and the test views of a scene, sorted by name: see ``Scene.split``.

    Every ``test_every``-th is a test view; the other arguments are those of ``load_views``.

    Raises:
        SceneNotFoundError: Images are missing, or too few.
        SceneFormatError: A camera has distortion, or an image cannot be used.
    """
    train, test = scene.split(test_every)
    if not train or not test:
        raise SceneNotFoundError(
            "at least two images with a pose, one to train on and one to test",
            found=f"{len(scene.images)}",
            fix="Name a scene with more photographs.",
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
    data_factor: int = 1,
    min_side: int = 1,
    undistort: bool = False,
    cache_dir: Path | None = None,
    progress: Progress = silent,
) -> tuple[View, ...]:
    """The views of some of a scene's images, in their order.

    Photographs are downsampled by ``data_factor``, to ``min_side`` pixels a side at least, and
    smaller copies kept in ``cache_dir``, if there is one. ``undistort`` removes lens distortion
    instead of refusing it. Pixels that the scene's masks leave out do not count.

    Raises:
        ParameterError: They do not fit into memory all together.
        SceneNotFoundError: An image or a mask is missing.
        SceneFormatError: A camera has distortion that is not removed, or an image or a mask is
            unusable.
    """
    folder = photograph_folder(scene)
    for image in images if not undistort else ():
        check_lens(image, scene.source.root if scene.source else None)
    if images:
        sizes, factor = check_sizes(images, folder), max(data_factor, 1)
        width, height = sizes[images[0].name]
        check_memory(
            sum(math.prod(size) for size in sizes.values()) // factor**2, 3,
            "pixels of photographs",
            found=f"{len(images)} of {width} x {height}, downsampled by {factor}",
            fix="Downsample more (`data_factor`), take fewer, or free some memory.",
        )  # fmt: skip
    views = []
    with ThreadPoolExecutor(READERS) as pool:
        for view in pool.map(
            lambda image: _load_view(
                image, folder, data_factor, min_side, cache_dir, scene.masks, scene.white
            ),
            images,
        ):
            views.append(view)
            progress("read images", len(views) / len(images))
    return tuple(views)


def check_lens(
    image: Image, scene: Path | None = None, reason: str = "which Gaussians are drawn with"
) -> None:
    """Refuse an image whose camera has lens distortion (SceneFormatError), and tell the ``reason``.

    ``scene`` is the folder of its scene, for the command in the advice.
    """
    if image.intrinsics.has_distortion:
        raise SceneFormatError(
            f"cameras without lens distortion (PINHOLE), {reason}",
            found=f"{image.intrinsics.model} for {image.name}",
            fix=undistort_first(scene),
        )


def _load_view(
    image: Image,
    folder: Path,
    data_factor: int,
    min_side: int,
    cache_dir: Path | None,
    masks: Masks | None,
    white: int,
) -> View:
    path = folder / image.name
    photograph, file_size = load_photograph(path, data_factor, cache_dir, white)
    height, width = photograph.shape[:2]
    if min(width, height) < min_side:
        raise _too_small(path, min_side, data_factor, (width, height))
    lens, pose = image.intrinsics.resized(*file_size), image.camera.cam_from_world
    K = np.diag([1 / data_factor, 1 / data_factor, 1.0]) @ lens.K
    mask = read_mask(masks, image.name, path, data_factor)
    if not lens.has_distortion:
        return View(image.name, photograph, K, width, height, pose, mask)
    from splatseed.photos.undistortion import undistort  # noqa: PLC0415  (loads Numba)

    photograph, known = undistort(photograph, lens, K)
    if mask is not None:
        shown = np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2)
        known &= undistort(shown, lens, K)[0][..., 0] == 255
    return View(image.name, photograph, K, width, height, pose, known)


def _too_small(
    name: Path | str, min_side: int, data_factor: int, size: tuple[int, int]
) -> SceneFormatError:
    pixels = "pixel" if min_side == 1 else "pixels"
    return SceneFormatError(
        f"{name} to have at least {min_side} {pixels} a side, reduced by a factor of {data_factor}",
        found=f"{size[0]} x {size[1]}",
        fix="Choose a smaller `data_factor`, or a larger `long_side`.",
    )


FILTER = "box-3"  # part of the key: change it whenever the downsampling changes


def load_photograph(
    path: StrPath, factor: int = 1, cache_dir: Path | None = None, white: int = WHITE
) -> tuple[UInt8[np.ndarray, "H W 3"], tuple[int, int]]:
    """The pixels of an image file, each a block of ``factor``^2, and the file's width and height.

    Transparent pixels are laid over black, which Gaussians are drawn on. Smaller copies are kept in
    ``cache_dir``, if there is one.
    """
    path = Path(path)
    if factor < 1:
        raise ParameterError(
            "`data_factor` of 1 or more", found=f"{factor}", fix="Images are never enlarged."
        )
    encoded = photograph_bytes(path)
    digest = hashlib.blake2b(encoded, digest_size=16, person=FILTER.encode()).hexdigest()
    kept = (
        None if cache_dir is None or factor == 1 else cache_dir / f"{digest}_{factor}_{white}.png"
    )
    if kept is not None and kept.is_file():
        with suppress(SceneFormatError):  # a damaged copy is made again
            photograph = decode_photograph(kept, photograph_bytes(kept))
            return np.array(photograph), open_photograph(path, encoded).size
    original = decode_photograph(path, encoded, white)
    width, height = original.width // factor, original.height // factor
    if not width or not height:
        raise _too_small(path, 1, factor, (width, height))
    photograph = original
    if factor > 1:
        photograph = original.reduce(factor, (0, 0, width * factor, height * factor))
    if kept is not None:
        with suppress(OutputError, OSError):  # a cache that cannot be written is done without
            kept.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(kept) as partial:
                photograph.save(partial, compress_level=1)
    return np.array(photograph), original.size


def user_cache_dir() -> Path:
    """Return the folder in which downsampled photographs are cached; it may not exist yet."""
    return user_cache_path("splatseed", appauthor=False) / "images"
