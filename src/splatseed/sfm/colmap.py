"""What the stages of a pycolmap run share, and triangulation at known poses.

Notation: a ``model`` is a ``pycolmap.Reconstruction``. Only ``require_pycolmap`` imports pycolmap.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias, TypeVar, get_args

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image as PilImage

from splatseed import errors
from splatseed.camera import Intrinsics
from splatseed.photos.panorama import FACES
from splatseed.progress import Progress
from splatseed.requirements import install_command
from splatseed.runtime.torch_device import DeviceName
from splatseed.scene import Image
from splatseed.sfm.cameras import Photos, SharedCamera
from splatseed.sfm.panoramas import PanoramaRig
from splatseed.sfm.photos import COPIES
from splatseed.sfm.work_folder import DATABASE, WorkFolder
from splatseed.text import numeric_order

MatcherName: TypeAlias = Literal["auto", "exhaustive", "sequential"]
T = TypeVar("T")

_MIN_VERSION = 4  # the first that adds an image with its rig in one call
_MAX_INT = 2**31 - 1  # pycolmap takes a 32-bit int
_POLL_SECONDS = 0.1
_LARGE = 1600  # px; longer sides of photographs whose features suffice without doubling


@dataclass(frozen=True)
class Settings:
    """Settings of feature detection, matching and reconstruction; validated.

    By default, photographs of 1,600 px and more are used at up to 2,000 px without doubling where
    poses are estimated or refined; any other ``max_image_size`` counts as it is.
    """

    matcher: MatcherName = "auto"
    """``auto`` matches pairs that agree at a first look, ``exhaustive`` all pairs, ``sequential``
    each image with its successors by name."""
    device: DeviceName = "auto"  # of features and matching; the rest runs on the CPU
    max_image_size: int = 1600  # px; larger photographs are reduced for features
    doubled: bool = True  # photographs, after that, for features: more and finer ones
    seed: int = 0  # of RANSAC and bundle adjustment
    threads: int = -1  # -1 = all cores

    def __post_init__(self) -> None:
        check_choice("matcher", self.matcher, get_args(MatcherName))
        check_choice("device", self.device, get_args(DeviceName))
        for name, low in (("max_image_size", 1), ("seed", 0), ("threads", 1)):
            value = getattr(self, name)
            if not low <= value <= _MAX_INT and (name, value) != ("threads", -1):
                raise errors.ParameterError(
                    f"`{name}` from {low} to {_MAX_INT}", found=f"{value}", fix="Choose another."
                )

    def for_poses(self, photos: Photos) -> Settings:
        """Return settings for estimating or refining poses; sizes that the caller chose stay.

        Large photographs are not doubled but used at up to 2,000 px: the pose error of 40 of a
        phone's of 1,920 px, refined, and of 97 of 1,800 px is the same, in a third of the time, by
        0.44 of the features or points.
        """
        chosen = (self.max_image_size, self.doubled)
        longer_sides = [max(photo.size) for photo in photos.values()]
        default = (Settings.max_image_size, Settings.doubled)
        if chosen == default and np.median(longer_sides) >= _LARGE:
            return replace(self, max_image_size=2000, doubled=False)
        return self


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise ``ParameterError`` unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise errors.ParameterError(
            f"`{name}` to be one of {', '.join(choices)}", found=repr(value), fix="Choose another."
        )


def require_pycolmap(device: DeviceName = "auto") -> Any:
    """Import pycolmap; refuse an old one, or one without support for ``device``."""
    # pycolmap's wheel exports its own zlib. A system libz loaded after it binds to that and
    # corrupts the heap at the first compression (PNG, gzip); loaded before it, it does not.
    importlib.import_module("zlib")
    fix = f"Install it (extra sfm): {install_command('pycolmap', upgrade=True)}."
    try:
        pycolmap = importlib.import_module("pycolmap")
    except (ImportError, RuntimeError) as error:  # RuntimeError: its C++ part does not load
        found = str(error).strip()
        raise errors.MissingDependencyError("pycolmap to load", found=found, fix=fix) from error
    found = f"pycolmap {pycolmap.__version__}"
    if int(pycolmap.__version__.split(".")[0]) < _MIN_VERSION:
        raise errors.MissingDependencyError(
            f"pycolmap {_MIN_VERSION} or newer", found=found, fix=fix
        )
    if device == "cuda" and not pycolmap.has_cuda:
        raise errors.MissingDependencyError(
            "a pycolmap with CUDA, for `device='cuda'`",
            found=f"{found} built for the CPU",
            fix="Pass `device='cpu'`, or install a CUDA build of pycolmap.",
        )
    return pycolmap


class Features(NamedTuple):
    """Features of a photograph."""

    uv: Float64[np.ndarray, "M 2"]  # pixels, centres at +0.5
    descriptors: UInt8[np.ndarray, "M 128"]


def find_features(
    greys: Sequence[UInt8[np.ndarray, "H W"]], zoom: float, num: int, progress: Progress
) -> list[Features]:
    """Find about ``num`` SIFT features, at most, in each grey photograph, enlarged by ``zoom``.

    A job of a child process.
    """
    pycolmap = require_pycolmap("cpu")
    pycolmap.logging.logtostderr = True  # not to files in the temporary folder
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    sift = {"first_octave": 0, "max_num_features": num}
    options = pycolmap.FeatureExtractionOptions(num_threads=1, use_gpu=False, sift=sift)
    if not hasattr(pycolmap, "FeatureExtractor"):
        raise errors.MissingDependencyError(
            "a pycolmap that finds features in arrays",
            found=f"pycolmap {pycolmap.__version__}",
            fix=f"Install a newer one (extra sfm): {install_command('pycolmap', upgrade=True)}.",
        )
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    found = []
    for number, grey in enumerate(greys):
        progress("find features", number / len(greys))
        height, width = grey.shape
        size = round(zoom * width), round(zoom * height)
        enlarged = np.array(PilImage.fromarray(grey).resize(size, PilImage.Resampling.BICUBIC))
        points, descriptors = extractor.extract_from_uint8_array(enlarged)
        uv = np.array([(point.x, point.y) for point in points], np.float64).reshape(-1, 2)
        uv *= np.array([width, height]) / size
        found.append(Features(uv, np.array(descriptors.data, np.uint8).reshape(-1, 128)))
    return found


@dataclass(frozen=True)
class ColmapRun:
    """Shared state of the stages of a run."""

    pycolmap: Any
    settings: Settings
    image_dir: Path
    work: Path  # a scratch folder, removed at the end
    on_progress: Progress
    kept: WorkFolder | None = None  # keeps features, matches and models after a failure
    holds_focal: bool = False  # keep the focal lengths that mapping starts from
    rigs: Sequence[PanoramaRig] = ()  # whose lenses and relative poses are known
    seconds: dict[str, float] = field(default_factory=dict)  # wall time of finished stages

    @property
    def database(self) -> Path:
        """The feature database."""
        return (self.kept.folder if self.kept else self.work) / DATABASE

    @property
    def readable(self) -> Path:
        """The photographs as features are found in them: copies where pycolmap needs some."""
        return copies if (copies := self.work / COPIES).is_dir() else self.image_dir

    def num_pairs(self) -> int:
        """Return the number of matched pairs, those without a match included."""
        with self.pycolmap.Database.open(self.database) as database:
            return int(database.num_matched_image_pairs())

    def stage(self, name: str, work: Callable[[], T], count: Callable[[], int], total: int) -> T:
        """Run ``work``, a blocking pycolmap call that releases the GIL, and report progress.

        ``count`` is polled for the number of finished items of ``total``.
        """

        def seeded() -> T:
            self.pycolmap.set_random_seed(self.settings.seed)  # of this thread
            return work()

        started = time.perf_counter()
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(seeded)
            self.on_progress(name, 0.0)
            while not wait([future], _POLL_SECONDS).done:
                self.on_progress(name, min(count() / max(total, 1), 1.0))
        self.on_progress(name, 1.0)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - started
        try:
            return future.result()
        except Exception as error:  # pycolmap raises any C++ exception of its libraries
            raise errors.ReconstructionError(
                f"pycolmap to finish {name}",
                found=f"{type(error).__name__}: {error}",
                fix="Check the disk space and the images.",
            ) from error


def guessed_model(run: ColmapRun, cameras: Sequence[SharedCamera], camera_model: str) -> Any:
    """Make a model without poses; focal lengths are from EXIF or defaults."""
    pycolmap, model = run.pycolmap, run.pycolmap.Reconstruction()
    options = pycolmap.ImageReaderOptions(camera_model=camera_model)
    ids: dict[str, int] = {name: i for rig in run.rigs for name, i in rig.camera_ids.items()}
    for camera_id, shared in enumerate(cameras, 1):
        camera = pycolmap.infer_camera_from_image(run.image_dir / shared.typical, options)
        camera.camera_id = camera_id
        model.add_camera_with_trivial_rig(camera)
        ids |= dict.fromkeys(shared.names, camera_id)
    ordered = sorted(ids, key=numeric_order)  # successors are neighbours
    images = {
        name: pycolmap.Image(name=name, image_id=number, camera_id=ids[name])
        for number, name in enumerate(ordered, 1)
    }
    for rig in run.rigs:
        _add_rig(pycolmap, model, rig, images)
    for image in images.values():
        model.add_image_with_trivial_frame(image)
    return model


def _known_camera(pycolmap: Any, camera_id: int, lens: Intrinsics) -> Any:
    return pycolmap.Camera(
        camera_id=camera_id,
        model=lens.model,
        width=lens.width,
        height=lens.height,
        params=list(lens.params),
        has_prior_focal_length=True,  # for the verification of matches
    )


def _add_rig(pycolmap: Any, model: Any, rig: PanoramaRig, images: dict[str, Any]) -> None:
    """Add the cameras and frames of panoramas of one size to a model, and their images.

    The images are taken out of ``images``. A frame has the id of its first image.
    """
    record = pycolmap.Rig(rig_id=rig.first_id)
    for camera_id, turn in enumerate(FACES.values(), rig.first_id):
        camera = _known_camera(pycolmap, camera_id, rig.lens)
        model.add_camera(camera)
        if camera_id == rig.first_id:  # the face in front, in the panorama's axes
            record.add_ref_sensor(camera.sensor_id)
        else:
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), np.zeros(3))
            record.add_sensor(camera.sensor_id, pose)
    model.add_rig(record)
    for names in rig.faces:
        faces = [images.pop(name) for name in names]
        frame = pycolmap.Frame(frame_id=faces[0].image_id, rig_id=rig.first_id)
        for image in faces:
            frame.add_data_id(image.data_id)
        model.add_frame(frame)
        for image in faces:
            image.frame_id = frame.frame_id
            model.add_image(image)


def posed_model(pycolmap: Any, poses: Sequence[Image], without: Collection[str] = ()) -> Any:
    """Make a model with the given poses and cameras; image id i is the i-th image.

    ``without``: names of images to omit.
    """
    model, ids = pycolmap.Reconstruction(), dict[int, int]()
    for number, posed in enumerate(poses, 1):
        lens = posed.intrinsics
        camera_id = ids.setdefault(lens.camera_id, len(ids) + 1)
        if not model.exists_camera(camera_id):
            model.add_camera_with_trivial_rig(_known_camera(pycolmap, camera_id, lens))
        if posed.name in without:
            continue
        image = pycolmap.Image(name=posed.name, image_id=number, camera_id=camera_id)
        model.add_image_with_trivial_frame(image, rigid(pycolmap, posed))
    return model


def rigid(pycolmap: Any, image: Image) -> Any:
    """Convert ``cam_from_world`` of an image to ``pycolmap.Rigid3d``."""
    rotation = pycolmap.Rotation3d(np.roll(image.quat, -1))  # wxyz to xyzw
    return pycolmap.Rigid3d(rotation, image.translation)


def mapping_options(run: ColmapRun) -> Any:
    """Return COLMAP's options of mapping and triangulation, for this run."""
    options = run.pycolmap.IncrementalPipelineOptions(
        num_threads=run.settings.threads, random_seed=run.settings.seed
    )
    options.constant_rigs = {rig.first_id for rig in run.rigs}
    options.constant_cameras = {rig.first_id + k for rig in run.rigs for k in range(len(FACES))}
    return options


def triangulate_points(
    run: ColmapRun, poses: Sequence[Image], without: Collection[str] = ()
) -> Path:
    """Triangulate points at fixed cameras and poses; return the folder of the model.

    ``without``: names of images to omit.
    """
    model_dir = run.work / "model"
    model_dir.mkdir()
    options = mapping_options(run)
    options.max_extra_param = math.inf  # known lenses are trusted: Kinects have a k3 above 1
    posed = posed_model(run.pycolmap, poses, without)
    model = run.stage(
        "triangulation",
        lambda: run.pycolmap.triangulate_points(
            posed, run.database, run.readable, model_dir, options=options
        ),
        posed.num_points3D,
        0,
    )
    if model.num_points3D() == 0:
        raise errors.ReconstructionError(
            f"points from the {len(poses)} posed images in {run.image_dir}",
            found="none where matching rays intersect",
            fix="Check that the poses belong to these images, in the same order and convention; "
            "a capture without sideways motion has no depth to triangulate.",
        )
    return model_dir
