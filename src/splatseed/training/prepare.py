"""Preparing a run: read the scene, make the first Gaussians, and open the run's folder.

Promise: nothing is written before the scene is known to be trainable; a resumed run has the
settings, seeds and poses that it started with.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.files import StrPath
from splatseed.io.photograph import photograph_folder
from splatseed.io.photograph_checks import check_sizes, with_photographs
from splatseed.io.seeds import was_upsampled
from splatseed.photos.camera_check import reference_points, stray_findings
from splatseed.photos.loading import load_split, refuse_distortion
from splatseed.photos.sizes import at_file_size
from splatseed.photos.view import View, camera_views
from splatseed.pointcloud import PointCloud
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.splat._kernels import WINDOW
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.training_frame import TrainingFrame, frame_of_model
from splatseed.text import counted
from splatseed.training.config import (
    another_scene,
    check_same_input,
    check_same_scene,
    has_run_poses,
    make_config,
    resumed_settings,
    trained_images,
    update_places,
    with_masks_of,
)
from splatseed.training.depths import DepthCache, known_depths
from splatseed.training.device import check_fits, device_name, pick_device
from splatseed.training.folder import RunFolder
from splatseed.training.initialization import first_gaussians
from splatseed.training.run import TrainingRun
from splatseed.training.seeds import seeded, seeds_facts, usable_seeds
from splatseed.training.settings import TrainSettings
from splatseed.training.start import continued_gaussians, read_start, start_facts
from splatseed.training.state import first_state, load_checkpoint, make_strategy


@dataclass(frozen=True)
class PrepareOptions:
    """What to do with a run's folder and its scene, besides training."""

    resume: bool = False
    """Resume the run in the folder, if there is one, with its own settings."""
    overwrite: bool = False
    """Replace an earlier run in the folder."""
    refine_poses: bool = False
    """First refine the poses of a phone or SLAM; points triangulated there replace the scene's,
    unless refinement gains nothing."""
    tensorboard: bool = False
    """Also write TensorBoard's log."""
    explicit: Collection[str] = ()
    """The settings that the user gave, which the run to resume must have even where they are the
    defaults."""
    cache_dir: Path | None = None
    """The folder for downsampled photographs; None: they are not kept."""
    depth_cache: DepthCache = field(default_factory=DepthCache)
    """The file in which the depths for strategy grow are kept."""


def prepare_run(
    scene: Scene,
    output: StrPath,
    settings: TrainSettings,
    options: PrepareOptions = PrepareOptions(),
    *,
    note: Note = silent_note,
    progress: Progress = silent,
) -> TrainingRun:
    """Read what a run needs, and open its folder.

    Args:
        scene: A scene with photographs; its points are the seeds.
        output: The folder of the run.
        settings: How to train.
        options: What to do with the folder and the scene.
        note: Called with notes for the user, one sentence each.
        progress: Called with the name of a stage and its fraction done.

    Raises:
        OutputError: ``output`` is taken, protected or cannot be written.
        SceneNotFoundError: Fewer than half of the photographs are there, or the run to resume lost
            its refined poses.
        SceneFormatError: A camera, a photograph or the run to resume cannot be used.
        PointCloudError: Too few points, or more than fit into memory.
        ParameterError: There is no GPU for backend cuda; settings or scene differ from those of the
            run to resume; poses are to be refined under seeds.
        ReconstructionError: Poses cannot be refined.
        MissingDependencyError: TensorBoard or pycolmap is needed and absent.
    """
    scene = _photographed(scene)  # before the folder is checked, which may be a bare cloud's
    folder, earlier = _open_folder(Path(output), options, scene, settings)
    refine_poses = options.refine_poses
    if earlier:
        settings, refine_poses = resumed_settings(
            earlier, settings, options.explicit, refine_poses=refine_poses
        )
        scene = with_masks_of(scene, earlier)
        check_same_scene(folder, earlier, scene, settings)
    settings = settings.with_data_factor(scene.images, note)
    device = pick_device(settings.backend, progress)
    given = scene.points.xyz
    if refine_poses:
        scene = _at_refined_poses(scene, folder, earlier, settings, note, progress)
    posed, stereo = scene, None
    if settings.start is None:
        triangulated = not np.array_equal(scene.points.xyz, given)
        scene, stereo = seeded(
            scene, settings, device.type, note, progress, triangulated=triangulated
        )
    initial = _initial(scene, settings, note)
    frame = initial.frame(scene, settings)
    for stray in stray_findings(frame.strays):
        note(stray)
    check_fits(initial.facts["count"], device)
    name = device_name(device)
    config = make_config(scene, initial.facts, settings, name, frame, refine_poses=refine_poses)
    if earlier:
        check_same_input(folder, earlier, config)
    views = load_split(
        scene,
        data_factor=settings.factor,
        test_every=settings.test_every,
        min_side=WINDOW,  # smaller views have no SSIM
        cache_dir=options.cache_dir,
        progress=progress,
    )
    depths, seconds = known_depths(
        scene, frame.scale, settings, device.type,
        stereo=stereo, cache=options.depth_cache.path, note=note, progress=progress,
    )  # fmt: skip
    strategy = make_strategy(settings, device, depths, len(depths) / max(1, len(views[0])))
    if earlier and folder.checkpoint.is_file():
        state = load_checkpoint(folder.checkpoint, strategy, settings.schedule, device)
    else:
        first = initial.gaussians(views[0], frame, settings, device, note)
        state = first_state(first, len(views[0]), settings, strategy, device)
    if state.step:
        note(f"Resuming after step {state.step:,} of {settings.max_steps:,}.")
    run = TrainingRun(folder, settings, frame, state, views)
    progress("compile", 0.0)
    with run.translate_errors():
        run.trainer.warm_up()
    # What cannot be rendered has failed by now, and leaves no folder.
    if earlier:
        update_places(folder, earlier, config)
    else:
        # The cost of growth includes stereo.
        state.watch.seconds += 0.0 if options.depth_cache.seconds_counted else seconds
        folder.create(config, posed if refine_poses else None, scene.offset)
    if options.tensorboard:
        run.log_to_tensorboard()
    return run


def _open_folder(
    path: Path, options: PrepareOptions, scene: Scene, settings: TrainSettings
) -> tuple[RunFolder, dict[str, Any] | None]:
    """Check the folder of the run; also return the config of the run to resume, if there is one."""
    if options.tensorboard:
        require("tensorboard")
    folder = RunFolder(path)
    inputs = scene.source.inputs if scene.source else ()
    protect = [*inputs, *([Path(settings.start)] if settings.start else [])]
    folder.check(overwrite=options.overwrite, resume=options.resume, protect=protect)
    return folder, folder.read_config() if options.resume and folder.is_run else None


def _initial(scene: Scene, settings: TrainSettings, note: Note) -> _Seeds | _Start:
    """Return what the run starts from: trained Gaussians, or the usable points of the scene."""
    if settings.start is not None:
        return _Start(_start_gaussians(Path(settings.start), scene, settings, note))
    trained = scene.split(settings.test_every)[0]
    poses = camera_views(trained, settings.factor)
    return _Seeds(usable_seeds(scene.points, settings, note, poses))


@dataclass(frozen=True)
class _Seeds:
    """A run's start from points."""

    points: PointCloud

    @property
    def facts(self) -> dict[str, Any]:
        return seeds_facts(self.points)

    def frame(self, scene: Scene, settings: TrainSettings) -> TrainingFrame:
        return frame_of_model(_train_poses(scene, settings), reference_points(scene), None)

    def gaussians(
        self,
        views: Sequence[View],
        frame: TrainingFrame,
        settings: TrainSettings,
        device: torch.device,  # noqa: ARG002  (the other start needs it)
        note: Note,  # noqa: ARG002
    ) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
        return first_gaussians(self.points, views, frame, settings)


@dataclass(frozen=True)
class _Start:
    """A run's start from trained Gaussians."""

    model: Gaussians

    @property
    def facts(self) -> dict[str, Any]:
        return start_facts(self.model)

    def frame(self, scene: Scene, settings: TrainSettings) -> TrainingFrame:
        # Without points, the Gaussians show where the scene is.
        return frame_of_model(_train_poses(scene, settings), reference_points(scene), self.model)

    def gaussians(
        self,
        views: Sequence[View],
        frame: TrainingFrame,
        settings: TrainSettings,
        device: torch.device,
        note: Note,
    ) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
        return continued_gaussians(self.model, views, frame, settings, device, note)


def _train_poses(scene: Scene, settings: TrainSettings) -> Sequence[View]:
    return camera_views(scene.split(settings.test_every)[0])


def _photographed(scene: Scene) -> Scene:
    """Drop images that cannot be trained on, and give cameras the sizes of the files."""
    source = scene.source
    if not scene.images:
        raise SceneNotFoundError(
            "a scene with photographs to train on",
            found=f"points alone{f' ({source.points_path})' if source else ''}",
            fix="Name a scene with cameras, images and photographs. To start from the points of a "
            "scan, add them to it: splatseed upsample SCENE --cloud FILE -o OUT.",
        )
    for image in scene.images:
        refuse_distortion(image, source.root if source else None)
    scene = with_photographs(scene)
    check_sizes(scene.images, photograph_folder(scene))
    return at_file_size(scene)


def _at_refined_poses(
    scene: Scene,
    folder: RunFolder,
    earlier: Mapping[str, Any] | None,
    settings: TrainSettings,
    note: Note,
    progress: Progress,
) -> Scene:
    """Return the scene at refined poses; those of the run to resume, if there is one."""
    from splatseed.sfm import refined, with_refined  # noqa: PLC0415  (pycolmap is optional)

    if earlier is not None:
        kept = load_scene(folder.scene)
        if {image.name for image in scene.images} != {image.name for image in kept.images}:
            where = scene.source.root if scene.source else "the scene"
            raise another_scene(folder, earlier, f"images in {where}")
        return with_refined(scene, kept)
    if was_upsampled(scene):
        raise ParameterError(
            "a scene that splatseed has not added points to, with `refine_poses`",
            found="seeds, which triangulated points would replace",
            fix="Name the scene that they were made from, or refine before seeds are made: "
            "splatseed upsample SCENE --refine-poses -o OUT.",
        )
    scene, message = refined(scene, settings.seed, progress, test_every=settings.test_every)
    note(message)
    return scene


def _start_gaussians(path: Path, scene: Scene, settings: TrainSettings, note: Note) -> Gaussians:
    """Read the Gaussians that the run continues from."""
    folder, same_poses = RunFolder(path.parent), False
    if path == folder.gaussians and folder.is_run:
        config = folder.read_config()
        same_poses = has_run_poses(config, scene)
        tests, trained = scene.split(settings.test_every)[1], trained_images(config, scene)
        if seen := sum(image.name in trained for image in tests):
            note(
                f"{path} was trained on {seen} of the {counted(len(tests), 'test view')}: scores "
                "will be too high."
            )
    return read_start(path, scene, note, same_poses=same_poses)
