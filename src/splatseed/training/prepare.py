"""Preparing a run: read the scene, make the first Gaussians, and open the run's folder.

Promise: nothing is written before the scene is known to be trainable; a resumed run has the
settings, seeds and poses that it started with.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from splatseed.checkup.examination import with_fitting_points
from splatseed.checkup.wrong_poses import leave_out, without_wrong_poses
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io import load_scene
from splatseed.io.exclusion import exclude
from splatseed.io.files import StrPath
from splatseed.io.photograph_checks import check_sizes, with_photographs
from splatseed.io.seeds import was_upsampled
from splatseed.photos.camera_check import reference_points, stray_findings
from splatseed.photos.loading import load_split, refuse_distortion
from splatseed.photos.view import View, camera_views
from splatseed.pointcloud import PointCloud
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.seeding.clouds.point_colors import with_colors
from splatseed.sfm import points_without_tracks, refined, with_refined
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
from splatseed.training.depths import NOT_CACHED, DepthCache, ImageDepths, known_depths
from splatseed.training.device import check_fits, device_name, pick_device
from splatseed.training.folder import RunFolder
from splatseed.training.initialization import first_gaussians
from splatseed.training.margins import has_margins, with_room
from splatseed.training.request import NEW_RUN, PrepareOptions
from splatseed.training.run import TrainingRun
from splatseed.training.seeds import no_seeding_reason, seeded, seeds_facts, usable_seeds
from splatseed.training.settings import TrainSettings
from splatseed.training.start import continued_gaussians, read_start, start_facts
from splatseed.training.state import TrainState, first_state, load_checkpoint, make_strategy


@dataclass(frozen=True)
class _Setup:
    """What all later stages need."""

    folder: RunFolder
    earlier: Mapping[str, Any] | None  # the config of the run to resume
    settings: TrainSettings
    refine_poses: bool
    device: torch.device
    note: Note
    progress: Progress


def prepare_run(
    scene: Scene,
    output: StrPath,
    settings: TrainSettings,
    options: PrepareOptions = NEW_RUN,
    *,
    named: Collection[str] = (),
    cache_dir: Path | None = None,
    depth_cache: DepthCache = NOT_CACHED,
    note: Note = silent_note,
    progress: Progress = silent,
) -> TrainingRun:
    """Read what a run needs, and open its folder.

    Args:
        scene: A scene with photographs; its points are the seeds.
        output: The folder of the run.
        settings: How to train.
        options: What to do with the folder and the scene.
        named: Settings of the caller, which the run to resume must have even if they are defaults.
        cache_dir: The folder for downsampled photographs; None: they are not kept.
        depth_cache: The file in which the depths for strategy grow are kept.
        note: Called with each finding for the user.
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
    scene = exclude(scene, options.exclude)
    excluded = scene.absent
    scene = _photographed(scene)  # before the folder is checked, which may be a bare cloud's
    scene, setup = _set_up(scene, Path(output), settings, options, named, note, progress)
    settings, folder = setup.settings, setup.folder
    posed, triangulated = scene, False
    if setup.refine_poses:
        posed = _at_refined_poses(scene, setup)
        triangulated = posed is not scene and not len(points_without_tracks(scene))
    if settings.start is None:
        posed = with_colors(posed, settings.test_every, note, progress)
    checked = _checked_up(posed, setup)
    scene, stereo = seeded(
        checked, settings, setup.device.type, note, progress, triangulated=triangulated
    )
    initial = _initial(scene, setup)
    frame = initial.frame(scene, settings)
    dropped = [image.name for image in posed.images if image.name not in checked]
    left_out = {"exclude": options.exclude, "excluded": excluded, "dropped": dropped}
    config = _checked_config(scene, initial, frame, setup, left_out)
    views = load_split(
        scene,
        data_factor=settings.factor,
        test_every=settings.test_every,
        min_side=WINDOW,  # smaller views have no SSIM
        cache_dir=cache_dir,
        progress=progress,
    )
    depths, seconds = known_depths(
        scene, frame.scale, settings, setup.device.type,
        stereo=stereo, cache=depth_cache.path, note=note, progress=progress,
    )  # fmt: skip
    state = _state(initial, views[0], frame, depths, setup)
    run = TrainingRun(folder, settings, frame, state, views)
    progress("compile", 0.0)
    with run.translate_errors():
        run.trainer.warm_up()
    # Errors of rendering come before this line, so that they leave no folder.
    if setup.earlier:
        update_places(folder, setup.earlier, config)
    else:
        # The cost of growth includes stereo.
        state.watch.seconds += 0.0 if depth_cache.seconds_counted else seconds
        folder.create(config, posed if setup.refine_poses else None, scene.offset)
    if options.tensorboard:
        run.log_to_tensorboard()
    return run


def _set_up(
    scene: Scene,
    output: Path,
    settings: TrainSettings,
    options: PrepareOptions,
    named: Collection[str],
    note: Note,
    progress: Progress,
) -> tuple[Scene, _Setup]:
    """Check the folder; a run to resume gives the settings and masks that were not named."""
    folder, earlier = _open_folder(output, options, scene, settings)
    refine_poses = options.refine_poses
    if earlier:
        settings, refine_poses = resumed_settings(
            earlier, settings, named, refine_poses=refine_poses
        )
        scene = with_masks_of(scene, earlier)
        check_same_scene(folder, earlier, scene, settings)
    settings = settings.with_data_factor(scene.images, note)
    device = pick_device(settings.backend, progress)
    return scene, _Setup(folder, earlier, settings, refine_poses, device, note, progress)


def _open_folder(
    path: Path, options: PrepareOptions, scene: Scene, settings: TrainSettings
) -> tuple[RunFolder, dict[str, Any] | None]:
    """Check the folder of the run; also return the config of the run to resume, if there is one."""
    if options.tensorboard:
        require("tensorboard")
    folder = RunFolder(path)
    protect = [*scene.source.inputs, *([Path(settings.start)] if settings.start else [])]
    folder.check(overwrite=options.overwrite, resume=options.resume, protect=protect)
    return folder, folder.read_config() if options.resume and folder.is_run else None


def _checked_up(scene: Scene, setup: _Setup) -> Scene:
    """Leave out or move points that photographs contradict, unless the run starts from them.

    Photographs with wrong poses are left out if the settings say so.
    """
    wrong: tuple[Finding, ...] = ()
    if setup.earlier:
        scene, wrong = leave_out(scene, setup.earlier.get("dropped") or ())
    elif setup.settings.drop_wrong_poses:
        scene, wrong = without_wrong_poses(scene, setup.progress)
    for finding in wrong:
        setup.note(finding)
    if was_upsampled(scene):  # which examined the points
        return scene
    settings, unfit_points = setup.settings, setup.settings.unfit_points
    starts_from_points = settings.seeding == "scene" or no_seeding_reason(scene, settings)
    if unfit_points == "drop" and starts_from_points:
        unfit_points = "keep"
    scene, findings = with_fitting_points(
        scene, unfit_points, setup.progress, test_every=settings.test_every
    )
    for finding in findings:
        setup.note(finding)
    return scene


def _initial(scene: Scene, setup: _Setup) -> _Seeds | _Start:
    """Return what the run starts from: trained Gaussians, or the usable points of the scene."""
    settings, note = setup.settings, setup.note
    if settings.start is not None:
        return _Start(_start_gaussians(Path(settings.start), scene, settings, note))
    poses = camera_views(scene.split(settings.test_every)[0], settings.factor)
    return _Seeds(usable_seeds(scene.points, settings, note, poses))


@dataclass(frozen=True)
class _Seeds:
    points: PointCloud

    @property
    def facts(self) -> dict[str, Any]:
        return seeds_facts(self.points)

    def frame(self, scene: Scene, settings: TrainSettings) -> TrainingFrame:
        return frame_of_model(_train_poses(scene, settings), reference_points(scene), None)

    def gaussians(
        self, views: Sequence[View], frame: TrainingFrame, setup: _Setup
    ) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
        return first_gaussians(self.points, views, frame, setup.settings)


@dataclass(frozen=True)
class _Start:
    model: Gaussians

    @property
    def facts(self) -> dict[str, Any]:
        return start_facts(self.model)

    def frame(self, scene: Scene, settings: TrainSettings) -> TrainingFrame:
        # Without points, the Gaussians show where the scene is.
        return frame_of_model(_train_poses(scene, settings), reference_points(scene), self.model)

    def gaussians(
        self, views: Sequence[View], frame: TrainingFrame, setup: _Setup
    ) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
        settings, device, note = setup.settings, setup.device, setup.note
        return continued_gaussians(self.model, views, frame, settings, device, note)


def _checked_config(
    scene: Scene,
    initial: _Seeds | _Start,
    frame: TrainingFrame,
    setup: _Setup,
    left_out: Mapping[str, Collection[str]],
) -> dict[str, Any]:
    """Return the content of config.json, once it fits the memory and the run to resume."""
    for stray in stray_findings(frame.strays):
        setup.note(stray)
    facts, device = initial.facts, setup.device
    check_fits(facts["count"], device)
    config = make_config(
        scene, facts, setup.settings, device_name(device), frame,
        refine_poses=setup.refine_poses, left_out=left_out,
    )  # fmt: skip
    if setup.earlier:
        check_same_input(setup.folder, setup.earlier, config)
    return config


def _state(
    initial: _Seeds | _Start,
    views: Sequence[View],
    frame: TrainingFrame,
    depths: ImageDepths,
    setup: _Setup,
) -> TrainState:
    """Return the state of the checkpoint, or before the first step; ``views`` are for training."""
    settings, device = setup.settings, setup.device
    growing = settings
    if has_margins(settings, views):
        growing = with_room(settings)
        text = "Past the edges of the photographs, the model will continue what they show."
        setup.note(Finding("margins", text, "info"))
    strategy = make_strategy(growing, device, depths, len(depths) / max(1, len(views)))
    checkpoint = setup.folder.checkpoint
    if setup.earlier and checkpoint.is_file():
        state = load_checkpoint(checkpoint, strategy, settings.schedule, device)
    else:
        first = initial.gaussians(views, frame, setup)
        state = first_state(first, len(views), settings, strategy, device)
    if state.step:
        text = f"Resuming after step {state.step:,} of {settings.max_steps:,}."
        setup.note(Finding("resumed-run", text, "info"))
    return state


def _train_poses(scene: Scene, settings: TrainSettings) -> Sequence[View]:
    return camera_views(scene.split(settings.test_every)[0])


def _photographed(scene: Scene) -> Scene:
    """Drop images without a photograph, and check that the others can be trained on."""
    source = scene.source
    if not scene.images:
        raise SceneNotFoundError(
            "a scene with photographs to train on",
            found=f"points alone{f' ({source.points_path})' if source.points_path else ''}",
            fix="Name a scene with cameras, images and photographs. To start from the points of a "
            "scan, add them to it: splatseed upsample SCENE --cloud FILE -o OUT.",
        )
    for image in scene.images:
        refuse_distortion(image, source.root)
    scene = with_photographs(scene)
    check_sizes(scene.images)
    return scene


def _at_refined_poses(scene: Scene, setup: _Setup) -> Scene:
    """Return the scene at refined poses; those of the run to resume, if there is one."""
    if setup.earlier is not None:
        kept = load_scene(setup.folder.scene)
        if {image.name for image in scene.images} != {image.name for image in kept.images}:
            where = scene.source.root or "the scene"
            raise another_scene(setup.folder, setup.earlier, f"images in {where}")
        return with_refined(scene, kept)
    if was_upsampled(scene):
        raise ParameterError(
            "a scene that splatseed has not added points to, with `refine_poses`",
            found="seeds, which were made at the given poses",
            fix="Name the scene that they were made from, or refine before seeds are made: "
            "splatseed upsample SCENE --refine-poses -o OUT.",
        )
    settings = setup.settings
    color = partial(
        with_colors, test_every=settings.test_every, note=setup.note, progress=setup.progress
    )
    scene, _, findings = refined(
        scene, settings.seed, setup.progress,
        test_every=settings.test_every, unfit_points=settings.unfit_points, color=color,
    )  # fmt: skip
    for finding in findings:
        setup.note(finding)
    return scene


def _start_gaussians(path: Path, scene: Scene, settings: TrainSettings, note: Note) -> Gaussians:
    folder, same_poses = RunFolder(path.parent), False
    if path == folder.gaussians and folder.is_run:
        config = folder.read_config()
        same_poses = has_run_poses(config, scene)
        tests, trained = scene.split(settings.test_every)[1], trained_images(config, scene)
        if seen := tuple(image.name for image in tests if image.name in trained):
            text = f"{path} was trained on {len(seen)} of the {counted(len(tests), 'test view')}: "
            note(Finding("trained-test-views", f"{text}scores will be too high.", "error", seen))
    return read_start(path, scene, note, same_poses=same_poses)
