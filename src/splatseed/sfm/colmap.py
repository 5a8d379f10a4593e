"""Stages of a pycolmap run: settings, mapping, triangulation; ``matching`` precedes them.

Notation: a ``model`` is a ``pycolmap.Reconstruction``. Only ``require_pycolmap`` imports pycolmap.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar, get_args

import numpy as np

from splatseed import errors
from splatseed.io.staging import remove
from splatseed.progress import Progress
from splatseed.requirements import install_command
from splatseed.runtime.torch_device import DeviceName
from splatseed.scene import Image
from splatseed.sfm.cameras import SharedCamera
from splatseed.sfm.work_folder import COMPLETE, DATABASE, MODELS, WorkFolder
from splatseed.text import counted, name_some, numeric_order

MatcherName: TypeAlias = Literal["auto", "exhaustive", "sequential"]
T = TypeVar("T")

_MIN_VERSION = 4  # the first that adds an image with its rig in one call
_MAX_INT = 2**31 - 1  # pycolmap takes a 32-bit int
_POLL_SECONDS = 0.1
_SNAPSHOTS = "snapshots"  # folder of models amid mapping
_SNAPSHOT_FRAMES = 50  # photographs mapped between two of them
_GROWTH = 1.25  # of the model between global adjustments; COLMAP's 1.1 takes 1.4 times as long
_TOLERANCE = 1e-6  # relative change of cost that ends an adjustment; 0 takes 1.3 times as long
_SIMPLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL")


@dataclass(frozen=True)
class Settings:
    """Settings of feature detection, matching and reconstruction; validated."""

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


def check_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise ``ParameterError`` unless ``value`` is one of ``choices``."""
    if value not in choices:
        raise errors.ParameterError(
            f"`{name}` to be one of {', '.join(choices)}", found=repr(value), fix="Choose another."
        )


def require_pycolmap(device: DeviceName = "auto") -> Any:
    """Import pycolmap.

    Raises:
        MissingDependencyError: Not installed, too old, or without support for ``device``.
    """
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


@dataclass(frozen=True)
class Run:
    """Shared state of the stages of a run."""

    pycolmap: Any
    settings: Settings
    image_dir: Path
    work: Path  # a scratch folder, removed at the end
    on_progress: Progress
    kept: WorkFolder | None = None  # keeps features, matches and models after a failure
    seconds: dict[str, float] = field(default_factory=dict)  # wall time of finished stages

    @property
    def database(self) -> Path:
        """The feature database."""
        return (self.kept.folder if self.kept else self.work) / DATABASE

    def num_pairs(self) -> int:
        """Return the number of matched pairs, those without a match included."""
        with self.pycolmap.Database.open(self.database) as database:
            return len(database.read_two_view_geometry_num_inliers()[0])

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


def guessed_model(run: Run, cameras: Sequence[SharedCamera], camera_model: str) -> Any:
    """Make a model without poses; focal lengths are from EXIF or defaults."""
    pycolmap, model = run.pycolmap, run.pycolmap.Reconstruction()
    options = pycolmap.ImageReaderOptions(camera_model=camera_model)
    ids: dict[str, int] = {}
    for camera_id, shared in enumerate(cameras, 1):
        camera = pycolmap.infer_camera_from_image(run.image_dir / shared.typical, options)
        camera.camera_id = camera_id
        model.add_camera_with_trivial_rig(camera)
        ids |= dict.fromkeys(shared.names, camera_id)
    for number, name in enumerate(sorted(ids, key=numeric_order), 1):  # successors are neighbours
        image = pycolmap.Image(name=name, image_id=number, camera_id=ids[name])
        model.add_image_with_trivial_frame(image)
    return model


def posed_model(pycolmap: Any, poses: Sequence[Image], without: Collection[str] = ()) -> Any:
    """Make a model with the given poses and cameras; image id i is the i-th image.

    ``without``: names of images to omit.
    """
    model, ids = pycolmap.Reconstruction(), dict[int, int]()
    for number, posed in enumerate(poses, 1):
        lens = posed.intrinsics
        camera_id = ids.setdefault(lens.camera_id, len(ids) + 1)
        if not model.exists_camera(camera_id):
            camera = pycolmap.Camera(
                camera_id=camera_id,
                model=lens.model,
                width=lens.width,
                height=lens.height,
                params=list(lens.params),
                has_prior_focal_length=True,  # for the verification of matches
            )
            model.add_camera_with_trivial_rig(camera)
        if posed.name in without:
            continue
        image = pycolmap.Image(name=posed.name, image_id=number, camera_id=camera_id)
        model.add_image_with_trivial_frame(image, rigid(pycolmap, posed))
    return model


def rigid(pycolmap: Any, image: Image) -> Any:
    """Convert ``cam_from_world`` of an image to ``pycolmap.Rigid3d``."""
    rotation = pycolmap.Rotation3d(np.roll(image.quat, -1))  # wxyz to xyzw
    return pycolmap.Rigid3d(rotation, image.translation)


def _options(run: Run) -> Any:
    return run.pycolmap.IncrementalPipelineOptions(
        num_threads=run.settings.threads, random_seed=run.settings.seed
    )


def map_images(
    run: Run,
    names: Sequence[str],
    camera_model: str,
    match_further: Callable[[Collection[str]], bool] | None,
    *,
    partial: bool,
) -> Path:
    """Estimate poses, lenses and points; return the folder of the model with the most images.

    ``match_further`` matches further pairs of photographs without a pose, by name, and returns
    whether some match; then mapping goes on. None if all pairs of the matcher are matched.

    Raises:
        ReconstructionError: No model, or one of fewer than half of the photographs while
            ``partial`` is False.
    """
    models_dir = (run.kept.folder if run.kept else run.work) / MODELS
    models = _mapped(run, models_dir, names, match_further)
    more = ["take more overlapping photographs", "remove those of other places"]
    chosen = match_further is not None or run.settings.matcher == "sequential"
    if chosen and run.num_pairs() < math.comb(len(names), 2):
        more.append("match all pairs with `matcher='exhaustive'`")
    if camera_model not in _SIMPLE:
        more.append("use a simpler camera model such as SIMPLE_RADIAL")
    advice = f"{', '.join(more[:-1])} or {more[-1]}"
    if run.kept:
        advice = f"{advice}; features and matches are kept in {run.kept.folder}"
    if not models:
        raise errors.ReconstructionError(
            f"a model of the {len(names)} photographs",
            found="no two that match well enough to start one",
            fix=f"{advice[0].upper()}{advice[1:]}.",
        )
    best = _largest(models)
    found = _posed(models[best])
    if 2 * len(found) < len(names) and not partial:
        raise errors.ReconstructionError(
            f"at least half of the {len(names)} photographs to get a pose",
            found=f"{len(found)} in the largest of {counted(len(models), 'model')}; "
            f"without a pose: {name_some([name for name in names if name not in found])}",
            fix=f"Pass `partial=True` to write the scene of these {len(found)}. For more, "
            f"{advice}.",
        )
    return models_dir / str(best)


def _mapped(
    run: Run,
    models_dir: Path,
    names: Sequence[str],
    match_further: Callable[[Collection[str]], bool] | None,
) -> dict[int, Any]:
    """Map images, or load the finished models of an earlier run; return models by number."""
    if (models_dir / COMPLETE).exists():
        folders = (path for path in models_dir.iterdir() if path.is_dir())
        return {int(path.name): run.pycolmap.Reconstruction(path) for path in folders}
    snapshot = _snapshot(models_dir / _SNAPSHOTS)
    for path in models_dir.iterdir() if models_dir.is_dir() else ():
        if path.name != _SNAPSHOTS:
            remove(path)
    models_dir.mkdir(exist_ok=True)
    if snapshot is None:
        models = _map(run, "mapping", models_dir, len(names))
    else:
        models = {0: _extend(run, "mapping", snapshot, models_dir / "0", len(names))}
    best = _largest(models)
    lost = sorted({*names} - _posed(models[best])) if models else list(names)
    if lost and match_further is not None and match_further(lost):
        if models:  # goes on from the largest model, whose photographs keep their matches
            folder = models_dir / str(best)
            models[best] = _extend(run, "further mapping", folder, folder, len(lost))
        else:
            models = _map(run, "further mapping", models_dir, len(names))
    registered = models[_largest(models)].num_reg_images() if models else 0
    if 2 * registered < len(names):
        models |= _map_globally(run, models_dir, max(models, default=-1) + 1, registered, names)
    remove(models_dir / _SNAPSHOTS)
    (models_dir / COMPLETE).touch()
    return models


def _map(
    run: Run, stage: str, folder: Path, total: int, given: Path | None = None
) -> dict[int, Any]:
    """Map images to models in numbered folders, or extend a given model in ``folder`` itself."""
    registered: list[None] = []  # except initial pairs
    options = _options(run)
    options.ba_global_frames_ratio = options.ba_global_points_ratio = _GROWTH
    options.ba_global_function_tolerance = options.ba_local_function_tolerance = _TOLERANCE
    if run.kept is not None:
        options.snapshot_path = run.kept.folder / MODELS / _SNAPSHOTS
        options.snapshot_path.mkdir(exist_ok=True)
        options.snapshot_frames_freq = _SNAPSHOT_FRAMES
    models: dict[int, Any] = run.stage(
        stage,
        lambda: run.pycolmap.incremental_mapping(
            *(run.database, run.image_dir, folder, options),
            **({} if given is None else {"input_path": given}),
            next_image_callback=lambda: registered.append(None),
        ),
        lambda: len(registered),
        total,
    )
    return models


def _extend(run: Run, stage: str, given: Path, folder: Path, total: int) -> Any:
    """Go on mapping from a given model, and write the result to ``folder``."""
    extended = folder.with_name("extended")
    extended.mkdir()
    (model,) = _map(run, stage, extended, total, given).values()
    remove(folder)
    extended.rename(folder)
    return model


def _map_globally(
    run: Run, models_dir: Path, number: int, registered: int, names: Sequence[str]
) -> dict[int, Any]:
    """Map all images at once; return the model by its number if it has more than ``registered``.

    That needs no initial pair, on which incremental mapping fails where a wrong focal length fits
    two photographs as well. The result is held to incremental mapping's criteria.
    """
    pycolmap, settings, folder = run.pycolmap, run.settings, models_dir / "global"
    options = pycolmap.GlobalPipelineOptions(
        num_threads=settings.threads, random_seed=settings.seed
    )
    folder.mkdir()
    try:
        models = run.stage(
            "global mapping",
            lambda: pycolmap.global_mapping(run.database, run.image_dir, folder, options),
            lambda: 0,
            1,
        )
        best = _largest(models)
        if not models or models[best].num_reg_images() <= registered:
            return {}
        into = models_dir / str(number)
        model = _extend(run, "further mapping", folder / str(best), into, len(names))
        return {number: model} if model.num_reg_images() > registered else {}
    except errors.ReconstructionError:
        return {}  # the models of incremental mapping are reported
    finally:
        remove(folder)


def _snapshot(folder: Path) -> Path | None:
    """Return the last model but one that a killed run wrote amid mapping: the last may be cut."""
    files = folder.iterdir() if folder.is_dir() else ()
    written = sorted(files, key=lambda path: path.stat().st_mtime_ns)
    return written[-2] if len(written) > 1 else None


def _largest(models: Mapping[int, Any]) -> int:
    """Return the number of the model with the most images, then points."""
    sizes = {i: (model.num_reg_images(), model.num_points3D()) for i, model in models.items()}
    return max(sizes, key=lambda i: sizes[i], default=0)


def _posed(model: Any) -> set[str]:
    return {image.name for image in model.images.values() if image.has_pose}


def triangulate_points(run: Run, poses: Sequence[Image], without: Collection[str] = ()) -> Path:
    """Triangulate points at fixed cameras and poses; return the folder of the model.

    ``without``: names of images to omit.
    """
    model_dir = run.work / "model"
    model_dir.mkdir()
    options = _options(run)
    options.max_extra_param = math.inf  # known lenses are trusted: Kinects have a k3 above 1
    posed = posed_model(run.pycolmap, poses, without)
    model = run.stage(
        "triangulation",
        lambda: run.pycolmap.triangulate_points(
            posed, run.database, run.image_dir, model_dir, options=options
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
