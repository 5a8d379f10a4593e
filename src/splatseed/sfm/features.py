"""One run of pycolmap: its settings, its stages, and the database of features and matches.

The database is written before any feature is detected, images with their cameras, so that ids are
ours: camera i has rig i, image i has frame i, counted from 1. pycolmap then only adds to it.
Progress is read from the database through pycolmap too: Python's sqlite3 is another copy of SQLite,
and two copies in one process drop each other's file locks and corrupt the file.

Notation: ``cameras`` and ``images`` are pycolmap's objects. Promise: a ``Settings`` that exists is
valid, and pycolmap is imported only by ``require_pycolmap``.
"""

from __future__ import annotations

import importlib
import importlib.util
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, get_args

from splatseed.errors import (
    MissingDependencyError,
    ParameterError,
    ReconstructionError,
    SceneFormatError,
)
from splatseed.progress import Progress
from splatseed.requirements import install_command
from splatseed.runtime.torch_device import DeviceName
from splatseed.scene import Image
from splatseed.sfm.photos import Photo, name_some

MatcherName: TypeAlias = Literal["exhaustive", "sequential"]
T = TypeVar("T")

_OLDEST = 4  # the first to pose an image and its rig in one call
_LARGEST = 2**31 - 1  # pycolmap takes a 32-bit int
_BLOCK_IMAGES = 16  # matches are committed, and progress is visible, per block of 16 x 16 pairs
_POLL_SECONDS = 0.1


@dataclass(frozen=True)
class Settings:
    """How features are detected and matched, and how the scene is solved.

    Args:
        matcher: ``exhaustive`` compares every pair of images; ``sequential`` each with its
            successors in the order of names, for a video.
        device: Where features are detected and matched; all else runs on the CPU.
        max_image_size: Longer sides are reduced to this many pixels for feature detection.
        seed: Seed of RANSAC and of the order of bundle adjustment.
        threads: Worker threads; -1 = all cores.

    Raises:
        ParameterError: A value is out of its range.
    """

    matcher: MatcherName = "exhaustive"
    device: DeviceName = "auto"
    max_image_size: int = 1600
    seed: int = 0
    threads: int = -1

    def __post_init__(self) -> None:
        check_choice("matcher", self.matcher, get_args(MatcherName))
        check_choice("device", self.device, get_args(DeviceName))
        threads = 1 if self.threads == -1 else self.threads
        for name, value, low in (
            ("max_image_size", self.max_image_size, 1),
            ("seed", self.seed, 0),
            ("threads", threads, 1),
        ):
            if not low <= value <= _LARGEST:
                raise ParameterError(
                    f"{name} from {low} to {_LARGEST}", found=f"{value}", fix="Choose another."
                )


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise ParameterError unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise ParameterError(
            f"{name} to be one of {', '.join(choices)}", found=repr(value), fix="Choose another."
        )


def check_installed() -> None:
    """Raise MissingDependencyError unless pycolmap is installed; does not import it."""
    if importlib.util.find_spec("pycolmap") is None:
        raise _missing("pycolmap to be installed", "no such package")


def require_pycolmap(device: DeviceName = "auto") -> Any:
    """Import pycolmap.

    Raises:
        MissingDependencyError: It is absent, does not load, is too old, or cannot use ``device``.
    """
    # pycolmap's wheel exports its own zlib. A system libz loaded after it binds to that and
    # corrupts the heap at the first compression (PNG, gzip); loaded before it, it does not.
    importlib.import_module("zlib")
    try:
        pycolmap = importlib.import_module("pycolmap")
    except (ImportError, RuntimeError) as error:  # RuntimeError: its C++ part does not load
        raise _missing("pycolmap to load", str(error).strip()) from error
    found = f"pycolmap {pycolmap.__version__}"
    if int(pycolmap.__version__.split(".")[0]) < _OLDEST:
        raise _missing(f"pycolmap {_OLDEST} or newer", found)
    if device == "cuda" and not pycolmap.has_cuda:
        raise MissingDependencyError(
            "a pycolmap that can use CUDA, as device='cuda' asks",
            found=f"{found} built for the CPU",
            fix="Use device='auto' or 'cpu', or install a CUDA build of pycolmap.",
        )
    return pycolmap


def _missing(expected: str, found: str) -> MissingDependencyError:
    fix = f"Install it (extra sfm): {install_command('pycolmap', upgrade=True)}."
    return MissingDependencyError(expected, found=found, fix=fix)


@dataclass(frozen=True)
class Run:
    """What the stages of one run share."""

    pycolmap: Any
    settings: Settings
    image_dir: Path
    work: Path
    """A scratch folder, removed at the end."""
    on_progress: Progress
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of the stages so far."""

    @property
    def database(self) -> Path:
        """The feature database."""
        return self.work / "database.db"

    @property
    def device(self) -> Any:
        """The device in pycolmap's terms."""
        return getattr(self.pycolmap.Device, self.settings.device)

    def stage(self, name: str, work: Callable[[], T], count: Callable[[], int], total: int) -> T:
        """What ``work`` returns, a blocking call of pycolmap, which releases the GIL.

        Meanwhile ``count`` says ten times a second how many of ``total`` items are done.

        Raises:
            ReconstructionError: pycolmap failed.
        """
        started = time.perf_counter()
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(self._seeded, work)
            self.on_progress(name, 0.0)
            while not wait([future], _POLL_SECONDS).done:
                self.on_progress(name, min(count() / max(total, 1), 1.0))
        self.on_progress(name, 1.0)
        self.seconds[name] = time.perf_counter() - started
        try:
            return future.result()
        except Exception as error:  # pycolmap throws whatever C++ type its libraries throw
            raise ReconstructionError(
                f"pycolmap to finish {name}",
                found=f"{type(error).__name__}: {error}",
                fix="Check the disk space and the images.",
            ) from error

    def _seeded(self, work: Callable[[], T]) -> T:
        self.pycolmap.set_random_seed(self.settings.seed)  # of this thread
        return work()


def guess_cameras(
    run: Run, photos: Sequence[Photo], camera_model: str, *, shared: bool
) -> tuple[list[Any], list[Any]]:
    """Cameras with EXIF's or a default focal length, and their images.

    With ``shared``, photographs of one size have one camera.
    """
    options = run.pycolmap.ImageReaderOptions()
    options.camera_model = camera_model
    cameras: dict[Any, Any] = {}
    images: list[Any] = []
    for photo in photos:
        key = (photo.width, photo.height) if shared else photo.name
        if key not in cameras:
            cameras[key] = run.pycolmap.infer_camera_from_image(run.image_dir / photo.name, options)
            cameras[key].camera_id = len(cameras)
        images.append(_image(run, photo.name, len(images) + 1, cameras[key].camera_id))
    return list(cameras.values()), images


def known_cameras(run: Run, pairs: Sequence[tuple[Photo, Image]]) -> tuple[list[Any], list[Any]]:
    """The cameras of posed photographs, exactly as given, and their images."""
    cameras: dict[int, Any] = {}
    images: list[Any] = []
    for photo, posed in pairs:
        lens = posed.intrinsics
        if lens.camera_id not in cameras:
            camera = run.pycolmap.Camera(
                camera_id=len(cameras) + 1,
                model=lens.model,
                width=lens.width,
                height=lens.height,
                params=list(lens.params),
            )
            camera.has_prior_focal_length = True  # matches are verified with the true focal length
            cameras[lens.camera_id] = camera
        images.append(_image(run, photo.name, len(images) + 1, cameras[lens.camera_id].camera_id))
    return list(cameras.values()), images


def _image(run: Run, name: str, image_id: int, camera_id: int) -> Any:
    image = run.pycolmap.Image()
    image.name, image.image_id, image.camera_id = name, image_id, camera_id
    return image


def match_photographs(run: Run, cameras: Sequence[Any], images: Sequence[Any]) -> None:
    """Create the database and fill it with features and verified matches.

    Raises:
        SceneFormatError: pycolmap could not use one of the photographs.
    """
    _write_database(run, cameras, images)
    _find_features(run, [image.name for image in images])
    _match_features(run)


def _write_database(run: Run, cameras: Sequence[Any], images: Sequence[Any]) -> None:
    pycolmap = run.pycolmap
    with pycolmap.Database.open(run.database) as database:
        for camera in cameras:
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for image in images:
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image.image_id, rig_id=image.camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)


def _find_features(run: Run, names: Sequence[str]) -> None:
    """Add SIFT features of every image to the database."""
    pycolmap = run.pycolmap
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = run.settings.max_image_size
    options.num_threads = run.settings.threads
    image_ids = range(1, len(names) + 1)
    with pycolmap.Database.open(run.database) as database:
        run.stage(
            "features",
            lambda: pycolmap.extract_features(
                run.database,
                run.image_dir,
                image_names=names,
                extraction_options=options,
                device=run.device,
            ),
            lambda: sum(map(database.exists_keypoints, image_ids)),
            len(names),
        )
        done = list(map(database.exists_keypoints, image_ids))
    skipped = [name for name, read in zip(names, done, strict=True) if not read]
    if skipped:
        raise SceneFormatError(
            f"pycolmap to read all images of {run.image_dir}",
            found=f"{len(skipped)} that it skipped: {name_some(skipped)}",
            fix="Export them again as 8-bit JPEG or PNG, or take them out of the folder.",
        )


def _match_features(run: Run) -> None:
    """Match the features of pairs of images and verify the matches geometrically."""
    pycolmap = run.pycolmap
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = run.settings.threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = run.settings.seed
    if run.settings.matcher == "exhaustive":
        match, pairing = pycolmap.match_exhaustive, pycolmap.ExhaustivePairingOptions()
        pairing.block_size = _BLOCK_IMAGES
        generator = pycolmap.ExhaustivePairGenerator
    else:
        match, pairing = pycolmap.match_sequential, pycolmap.SequentialPairingOptions()
        generator = pycolmap.SequentialPairGenerator
    with pycolmap.Database.open(run.database) as database:
        num_pairs = len(set(generator(pairing, database).all_pairs()))
        run.stage(
            "matching",
            lambda: match(
                run.database,
                matching_options=matching,
                pairing_options=pairing,
                verification_options=verification,
                device=run.device,
            ),
            database.num_matched_image_pairs,
            num_pairs,
        )
