"""A training run, from a scene to a folder of results.

Promise: nothing is written before the scene is known to be trainable; an interrupted run resumes
where it stopped, never with other settings, seeds or poses than it began with; results are in the
scene's world; the end of a GPU's memory is told in a sentence, with a number to try.
"""

from __future__ import annotations

import dataclasses
import platform
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from splatseed.errors import (
    OutputError,
    ParameterError,
    PointCloudError,
    SceneFormatError,
    SceneNotFoundError,
)
from splatseed.io import load_scene
from splatseed.io.files import StrPath
from splatseed.io.masks import mask_choice, with_masks
from splatseed.io.photograph import photograph_folder, photographs_digest
from splatseed.io.photograph_checks import check_sizes, with_photographs
from splatseed.io.seeds import was_upsampled
from splatseed.io.staging import write_json
from splatseed.photos.sight import notes_on, shown_points
from splatseed.photos.view import View, at_file_size, check_lens, load_split, poses_of
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.scores import CurvePoint, EvalResult, TrainingResult
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians, TrainingFrame, frame_of_model
from splatseed.splat.rendering import ModelRenderer, picture_names, write_render
from splatseed.splat.ssim import WINDOW
from splatseed.text import counted
from splatseed.training.device import check_fits, pick_device
from splatseed.training.folder import Record, RunFolder, write_curve_csv, write_curve_png
from splatseed.training.parameters import gaussians_of, take_mean
from splatseed.training.seeds import (
    first_gaussians,
    known_depths,
    seeded,
    seeds_facts,
    usable_seeds,
)
from splatseed.training.settings import TrainSettings
from splatseed.training.start import read_start, start_facts, started_gaussians
from splatseed.training.state import (
    TrainState,
    first_state,
    load_checkpoint,
    make_strategy,
    save_checkpoint,
)
from splatseed.training.trainer import Trainer

Score = Callable[..., EvalResult]
"""Scores renders against views, and calls ``on_view``, as ``evaluate.evaluate_views`` does."""

SAVE_EVERY = 60.0
"""Least seconds between checkpoints, so that saving stays a small part of the time."""
FEWER = 0.8
"""The part of the Gaussians to try again with where memory ended."""
_PLACES = ("scene", "points")
"""Where the scene lies, in a config; its content is the same wherever that is."""
LOGGED = ("seconds", "loss", "psnr/train", "psnr/test", "gaussians", "ssim/test")
"""TensorBoard's names of a record's numbers, after the step."""


def prepare_run(
    scene: Scene,
    output: StrPath,
    settings: TrainSettings,
    *,
    resume: bool = False,
    named: Collection[str] = (),
    overwrite: bool = False,
    refine_poses: bool = False,
    tensorboard: bool = False,
    cache_dir: Path | None = None,
    depths: Path | None = None,
    seeding_knew: bool = False,
    note: Callable[[str], None] = lambda _: None,
    progress: Progress = silent,
) -> TrainingRun:
    """Read what a run needs, and open its folder.

    Args:
        scene: A scene with photographs; its points are the seeds.
        output: The folder of the run.
        settings: How to train.
        resume: Resume the run in the folder, if there is one, with its own settings.
        named: The settings that the user gave, which a run to resume must have; others need not be
            its own where they are the defaults.
        overwrite: Replace an earlier run in the folder.
        refine_poses: Refine poses of a phone or SLAM first, and triangulate points, which replace
            the scene's.
        tensorboard: Also write TensorBoard's log.
        cache_dir: Where smaller photographs are cached; nowhere when left out.
        depths: The file in which the depth that stereo finds, for growth, is kept for other runs
            on the same photographs with the same seed; nowhere when left out. Each run's time
            counts what finding it took.
        seeding_knew: Whether that time is already counted as making the seeds.
        note: Called with notes for the user, one sentence each.
        progress: Called with the stage and the fraction done.

    Raises:
        OutputError: ``output`` is taken, protected or cannot be written.
        SceneNotFoundError: Fewer than half of the photographs are there, or the run to resume lost
            its refined poses.
        SceneFormatError: A camera, a photograph or the run to resume cannot be used.
        PointCloudError: Too few points, or more than fit into memory.
        ParameterError: No GPU although one was requested; settings or a scene that differ from the
            run's; poses to be refined under seeds.
        ReconstructionError: Poses cannot be refined.
        MissingDependencyError: TensorBoard or pycolmap is needed and absent.
    """
    scene = _photographed(scene)  # before the folder is looked at, which may be a cloud's own
    if tensorboard:
        require("tensorboard")
    folder = RunFolder(Path(output))
    inputs = scene.source.inputs if scene.source else ()
    protect = [*inputs, *([Path(settings.start)] if settings.start else [])]
    folder.check(overwrite=overwrite, resume=resume, protect=protect)
    begun = folder.read_config() if resume and folder.is_run else None
    if begun:
        settings, refine_poses = resumed(begun, settings, named, refine_poses=refine_poses)
        scene = _as_masked(scene, begun)
    settings, device = settings.sized(scene.images, note), pick_device(settings.backend, progress)
    if refine_poses:
        scene = _at_refined_poses(scene, folder, begun, settings, note, progress)
    posed, stereo = scene, None
    start = _started(settings.start, scene, note)
    if start is None:
        scene, stereo = seeded(scene, settings, device.type, note, progress)
        trained = scene.split(settings.test_every)[0]
        seeds = usable_seeds(scene.points, settings, note, poses_of(trained, settings.factor))
    frame = _frame_of(scene, settings, start)
    for told in notes_on(frame.strays):
        note(told)
    check_fits(len(seeds if start is None else start), device)
    began = seeds_facts(seeds) if start is None else start_facts(start)
    config = make_config(scene, began, settings, _name(device), refine_poses=refine_poses)
    # For renders of the run: they are made in the frame of training.
    config["near_plane"] = frame.near / frame.scale
    config["frame"] = {"origin": frame.origin.tolist(), "scale": frame.scale}
    _check_begun(folder, begun, config)
    views = load_split(
        scene,
        data_factor=settings.factor,
        test_every=settings.test_every,
        min_side=WINDOW,  # smaller views have no SSIM
        cache_dir=cache_dir,
        progress=progress,
    )
    known, seconds = known_depths(
        scene, frame.scale, settings, device.type,
        stereo=stereo, kept=depths, note=note, progress=progress,
    )  # fmt: skip
    strategy = make_strategy(settings, device, known, len(known) / max(1, len(views[0])))
    if begun and folder.checkpoint.is_file():
        state = load_checkpoint(folder.checkpoint, strategy, settings.schedule, device)
    else:
        first = (
            first_gaussians(seeds, views[0], frame, settings)
            if start is None
            else started_gaussians(start, views[0], frame, settings, device, note)
        )
        state = first_state(first, len(views[0]), settings, strategy, device)
    if state.step:
        note(f"Resuming after step {state.step:,} of {settings.max_steps:,}.")
    run = TrainingRun(folder, settings, frame, state, views)
    progress("compile", 0.0)
    with run.told():
        run.trainer.warm_up()
    # What cannot render has failed by now, and leaves no folder.
    if not begun:
        # The cost of growth includes finding depth.
        state.watch.seconds += 0.0 if seeding_knew else seconds
        folder.begin(config, posed if refine_poses else None, scene.offset)
    else:
        _note_places(folder, begun, config)
    if tensorboard:
        run.log_to_tensorboard()
    return run


def _frame_of(scene: Scene, settings: TrainSettings, start: Gaussians | None) -> TrainingFrame:
    """The frame of the training views; where there are no points, Gaussians show the scene."""
    poses = poses_of(scene.split(settings.test_every)[0])
    return frame_of_model(poses, shown_points(scene), start)


def _photographed(scene: Scene) -> Scene:
    """The scene with the images that can be trained on, and cameras of their files' sizes."""
    source = scene.source
    if not scene.images:
        raise SceneNotFoundError(
            "a scene with photographs to train on",
            found=f"points alone{f' ({source.points_path})' if source else ''}",
            fix="Name a scene with cameras, images and photographs. To begin with the points of a "
            "scan, add them to it: splatseed upsample SCENE --cloud FILE -o OUT.",
        )
    for image in scene.images:
        check_lens(image, source.root if source else None)
    scene = with_photographs(scene)
    check_sizes(scene.images, photograph_folder(scene))
    return at_file_size(scene)


def _at_refined_poses(
    scene: Scene,
    folder: RunFolder,
    begun: Mapping[str, Any] | None,
    settings: TrainSettings,
    note: Callable[[str], None],
    progress: Progress,
) -> Scene:
    """The scene at refined poses; those that a resumed run keeps, if it has ``begun``."""
    from splatseed.sfm import refined, with_refined  # noqa: PLC0415  (loads with its use)

    if begun is not None:
        kept = load_scene(folder.scene)
        if {image.name for image in scene.images} != {image.name for image in kept.images}:
            where = scene.source.root if scene.source else "the scene"
            raise _another_scene(folder, begun, f"images in {where}")
        return with_refined(scene, kept)
    if was_upsampled(scene):
        raise ParameterError(
            "a scene that splatseed has not added points to, with `refine_poses`",
            found="seeds, which triangulated points would replace",
            fix="Name the scene that they were made from, or refine before seeds are made: "
            "splatseed upsample SCENE --refine-poses -o OUT.",
        )
    scene, told = refined(scene, settings.seed, progress, test_every=settings.test_every)
    note(told)
    return scene


def make_config(
    scene: Scene,
    seeds: Mapping[str, Any],
    settings: TrainSettings,
    device: str,
    *,
    refine_poses: bool = False,
) -> dict[str, Any]:
    """The content of config.json; ``seeds`` are the facts of what the run begins with."""
    source = scene.source
    points = source.points_path if source and not refine_poses else None
    return {
        "splatseed": _version("splatseed"),
        "scene": str(source.again) if source else None,
        "points": str(points.resolve()) if points else None,
        "refine_poses": refine_poses,
        "masks": mask_choice(scene),
        **dataclasses.asdict(settings),
        "device": device,
        "seeds": dict(seeds),
        "photographs": photographs_digest(scene),
        "versions": {
            "python": platform.python_version(),
            **{name: _version(name) for name in ("torch", "gsplat", "numba", "numpy")},
        },
    }


def _started(named: str | None, scene: Scene, note: Callable[[str], None]) -> Gaussians | None:
    """The Gaussians of the file that a run starts from, if it names one."""
    if named is None:
        return None
    folder, trained = RunFolder(Path(named).parent), False
    if Path(named) == folder.gaussians and folder.is_run:
        trained = folder.read_config().get("photographs") == photographs_digest(scene)
    return read_start(Path(named), scene, note, trained=trained)


def _version(package: str) -> str | None:
    """None for a package that is run from its source tree."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def resumed(
    begun: Mapping[str, Any],
    asked: TrainSettings,
    named: Collection[str] = (),
    *,
    refine_poses: bool,
) -> tuple[TrainSettings, bool]:
    """The settings of a resumed run, and whether it refined poses, by the config it began with.

    What is not ``named`` and has its default is as the run has it, but for the backend, which may
    change; anything else must be the run's own. An older version's config may lack a setting.
    """
    default = {**dataclasses.asdict(TrainSettings()), "refine_poses": False}
    now = {**dataclasses.asdict(asked), "refine_poses": refine_poses}
    then = {name: begun.get(name, each) for name, each in default.items() if name != "backend"}
    then["data_factor"] = begun.get("data_factor", 1)  # None is no run's
    for name, value in then.items():
        if now[name] != value and (name in named or now[name] != default[name]):
            raise ParameterError(
                f"`{name}={value!r}`, as when the run began",
                found=f"{now[name]}",
                fix="Leave it out to resume, or start again with `overwrite=True`.",
            )
    refined = then.pop("refine_poses") is True
    try:
        return dataclasses.replace(asked, **then), refined
    except TypeError:
        raise SceneFormatError(
            "the settings of a run in the config.json of the run",
            found="a text instead of a number",
            fix="Start again with `overwrite=True`.",
        ) from None


def _check_begun(
    folder: RunFolder, begun: Mapping[str, Any] | None, config: Mapping[str, Any]
) -> None:
    """Refuse to resume from other seeds, or another start, than the run began with."""
    if begun and begun.get("seeds") != config["seeds"]:
        which = f"Gaussians in {config['start']}" if config["start"] else ""
        raise _another_scene(folder, begun, which or f"points in {config['scene']}")
    if begun and begun.get("photographs") != config["photographs"]:
        raise _another_scene(folder, begun, f"photographs or poses in {config['scene']}")


def _note_places(folder: RunFolder, begun: Mapping[str, Any], config: Mapping[str, Any]) -> None:
    """Record where the scene of a resumed run lies now, so that evaluate and view find it."""
    moved = {name: config[name] for name in _PLACES if begun.get(name) != config[name]}
    if moved:
        write_json(folder.config, {**begun, **moved})


def _as_masked(scene: Scene, begun: Mapping[str, Any]) -> Scene:
    """The scene with the masks of a run that has begun; a choice of its own must be the same."""
    now, then = mask_choice(scene), begun.get("masks")
    if now is None and isinstance(then, str):
        return with_masks(scene, then)
    if now != then:
        raise ParameterError(
            f"`masks={then!r}`, as when the run began",
            found=str(now),
            fix="Leave it out to resume, or start again with `overwrite=True`.",
        )
    return scene


def _another_scene(folder: RunFolder, begun: Mapping[str, Any], found: str) -> ParameterError:
    return ParameterError(
        f"the scene that the run began with ({begun.get('scene')}, says {folder.config})",
        found=f"other {found}",
        fix="Name that scene, or start again with `overwrite=True`.",
    )


def _name(device: torch.device) -> str:
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU, {counted(torch.get_num_threads(), 'thread')}"


class TrainingRun:
    """A run that is ready to train, at its first step or where it stopped.

    ``views`` are the training and the test views, in the world.
    """

    def __init__(
        self,
        folder: RunFolder,
        settings: TrainSettings,
        frame: TrainingFrame,
        state: TrainState,
        views: tuple[Sequence[View], Sequence[View]],
    ) -> None:
        self.folder, self.settings, self.state, self.frame = folder, settings, state, frame
        self._board: Any = None  # TensorBoard's writer, if asked for
        self._saved, self._saved_step = time.monotonic(), state.step or None
        self._test_views = views[1]
        train, test = ([frame.view(view) for view in part] for part in views)
        self._pictures = picture_names(view.name for view in test)
        self.trainer = Trainer(state, settings, train, test, self._on_record)

    def log_to_tensorboard(self) -> None:
        """Also write TensorBoard's log, into the run's folder."""
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  (optional)

        # Entries of an interrupted run beyond this step are dropped.
        path, first = self.folder.tensorboard, self.state.step + 1
        self._board = SummaryWriter(str(path), purge_step=first)
        self.folder.claim([path])

    def count(self) -> int:
        """The number of Gaussians."""
        return len(self.state.params["means"])

    @property
    def device(self) -> str:
        """Where it trains, in words."""
        return _name(self.trainer.device)

    @property
    def peak_gpu_bytes(self) -> int | None:
        """Most bytes that PyTorch held on the GPU so far; None on the CPU."""
        device = self.trainer.device
        return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None

    def train(self, on_step: Callable[[int], None] = lambda _: None) -> bool:
        """Train to the end, or until the user interrupts; a checkpoint is saved.

        ``on_step`` is called with the number of steps done, after each. Returns whether the last is
        done.

        Raises:
            OutputError: The checkpoint or the curve cannot be written.
            PointCloudError: The GPU's memory does not suffice; the checkpoint is of the last step.
        """
        with self.told():
            if self._saved_step is None:
                self._save()  # fail now rather than after hours if the disk is full
            try:
                done = self.trainer.run(on_step)
            except torch.cuda.OutOfMemoryError:
                if self.trainer.is_whole:  # else the checkpoint before is the last whole one
                    self.trainer.clear_gradients()
                    self._save()
                raise
            if self._board:
                self._board.close()
            self._save()  # for a finished run too: scoring and writing results may fail
        return done

    def finish(self, score: Score, progress: Progress = silent) -> TrainingResult:
        """Write the Gaussians, score them and write the results; then the checkpoint is removed.

        Returns what is written to metrics.json.

        Raises:
            OutputError: A result cannot be written.
            PointCloudError: The GPU's memory does not suffice.
        """
        state, folder = self.state, self.folder
        if state.step < self.settings.max_steps:  # at its last step training has taken it
            take_mean(state.params, state.mean)
        with self.told():
            progress("score", 0.0)
            folder.claim([folder.renders / name for name in self._pictures.values()])
            write_gaussians(
                folder.gaussians, self.frame.gaussians_to_world(gaussians_of(state.params))
            )
            # What is scored is what the user gets: the file, read back.
            world = read_gaussians(folder.gaussians)
            render = ModelRenderer(world, self.frame, self.trainer.device).image
            scores = score(render, self._test_views, on_view=self._draw)
            result = TrainingResult(
                dataclasses.replace(scores, num_gaussians=len(world), model_bytes=world.num_bytes),
                tuple(
                    CurvePoint(r.step, r.seconds, r.test_psnr, r.num_gaussians, r.test_ssim)
                    for r in state.records
                    if r.test_psnr is not None
                ),
                steps=state.step,
                train_seconds=round(state.watch.seconds, 3),
                num_seeds=folder.read_config()["seeds"]["count"],
                held_by_memory_at=state.strategy.capacity.held_at,
            )
            write_curve_csv(folder.curve_csv, state.records)
            write_curve_png(folder.curve_png, state.records)
            write_json(folder.metrics, result.to_dict())  # last: the run has finished
            folder.checkpoint.unlink(missing_ok=True)
        return result

    def _draw(
        self, view: View, render: Float32[np.ndarray, "H W 3"], errors: Float32[np.ndarray, "H W"]
    ) -> None:
        path = self.folder.renders / self._pictures[view.name]
        write_render(path, view.photograph, render, errors)

    def _on_record(self, record: Record) -> None:
        if self._board:
            for name, value in zip(LOGGED, record[1:], strict=True):
                if value is not None:
                    self._board.add_scalar(name, value, record.step)
        if record.test_psnr is None:
            return
        write_curve_csv(self.folder.curve_csv, self.state.records)
        if self._saved_step is None or time.monotonic() - self._saved > SAVE_EVERY:
            self._save()

    def _save(self) -> None:
        save_checkpoint(self.folder.checkpoint, self.state)
        self._saved, self._saved_step = time.monotonic(), self.state.step

    @contextmanager
    def told(self) -> Iterator[None]:
        """Say what ended the block, as the end of memory, and which step is kept."""
        try:
            yield
        except torch.cuda.OutOfMemoryError as error:
            raise PointCloudError(
                "Gaussians and photographs that fit into the GPU's memory",
                found=f"no memory left with {self.count():,} Gaussians",
                fix=f"Start again with `budget={round(FEWER * self.count())}` or smaller "
                f"photographs (`data_factor`), or end other programs on the GPU.{self._kept()}",
            ) from error
        except OutputError as error:
            fix = error.fix + self._kept()
            raise OutputError(error.expected, found=error.found, fix=fix) from error
        except KeyboardInterrupt as error:
            if kept := self._kept():
                error.add_note(kept.strip())
            raise

    def _kept(self) -> str:
        """A sentence on the checkpoint, if there is one, after another sentence."""
        if self._saved_step is None:
            return ""
        return f" The run as of step {self._saved_step:,} is kept: continue it with `resume=True`."
