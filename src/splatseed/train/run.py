"""A training run, from a scene to a folder of results.

Promise: nothing is written before the scene is known to be trainable; an interrupted run resumes
where it stopped, with its original settings; results are in the scene's world.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.errors import OutputError, PointCloudError, SceneNotFoundError
from splatseed.io.staging import write_json
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.scores import CurvePoint, EvalResult, TrainingResult
from splatseed.splat.formats import write_model
from splatseed.splat.gaussians import TrainingFrame, stray_note, stray_views, training_frame
from splatseed.splat.rendering import picture_name, write_render
from splatseed.splat.ssim import WINDOW
from splatseed.train.depths import known_depths
from splatseed.train.device import (
    check_fits,
    device_name,
    gpu_memory_told,
    peak_gpu_bytes,
    pick_device,
)
from splatseed.train.folder import RunFolder
from splatseed.train.parameters import gaussians_of, make_optimizers, make_parameters
from splatseed.train.record import (
    Board,
    Record,
    check_same_seeds,
    make_config,
    resumed_reading,
    resumed_settings,
    scene_as_read,
    write_curve_csv,
    write_curve_png,
)
from splatseed.train.seeds import first_gaussians, seeded, usable_seeds
from splatseed.train.settings import AS_IT_IS, Reading, TrainSettings
from splatseed.train.state import TrainState, load_checkpoint, make_strategy, save_checkpoint
from splatseed.train.strategies import Strategy
from splatseed.train.trainer import Trainer
from splatseed.views.view import View, check_lens, load_split, poses_of

Render = Callable[[View], Float[Tensor, "H W 3"]]
Score = Callable[[Render, Sequence[View]], EvalResult]
"""Scores renders against views, as ``evaluate.evaluate_views`` does."""

SAVE_EVERY = 60.0
"""Least seconds between checkpoints, so that saving stays a small part of the time."""


@dataclass(frozen=True)
class RunOptions:
    """What a run does besides training.

    Args:
        resume: Resume the run in the folder, if there is one, with its own settings.
        overwrite: Replace an earlier run in the folder.
        tensorboard: Also write TensorBoard's log.
        cache_dir: Where smaller photographs are cached; nowhere when left out.
        depths: The file in which the depth that stereo finds, for growth, is kept for other runs
            on the same photographs with the same seed; nowhere when left out. Each run's time
            counts what finding it took.
        seeding_knew: Whether that time is already counted as making the seeds.
        reading: What to do with the scene before.
    """

    resume: bool = False
    overwrite: bool = False
    tensorboard: bool = False
    cache_dir: Path | None = None
    depths: Path | None = None
    seeding_knew: bool = False
    reading: Reading = AS_IT_IS


def prepare_run(
    scene: Scene,
    output: Path,
    settings: TrainSettings,
    options: RunOptions | None = None,
    *,
    note: Callable[[str], None] = lambda _: None,
    progress: Progress = silent,
) -> TrainingRun:
    """Read what a run needs, and open its folder.

    Args:
        scene: A scene with photographs; its points are the seeds.
        output: The folder of the run.
        settings: How to train.
        options: What else to do.
        note: Called with notes for the user, one sentence each.
        progress: Called with the stage and the fraction done.

    Raises:
        OutputError: ``output`` is taken, protected or cannot be written.
        SceneNotFoundError: Photographs are missing.
        SceneFormatError: A camera, a photograph or the run to resume cannot be used.
        PointCloudError: Too few points, or more than fit into memory.
        ParameterError: No GPU although one was requested; settings that differ from the run's.
        ReconstructionError: Poses cannot be refined.
        MissingDependencyError: TensorBoard or pycolmap is needed and absent.
    """
    options = options or RunOptions()
    _check_images(scene)
    if options.tensorboard:
        require("tensorboard")
    folder = RunFolder(Path(output))
    protect = scene.source.inputs if scene.source else ()
    folder.check(overwrite=options.overwrite, resume=options.resume, protect=protect)
    begun, reading = None, options.reading
    if options.resume and folder.is_run:
        begun = folder.read_config()
        settings = resumed_settings(begun, settings)
        reading = resumed_reading(begun, reading)
    for image in scene.images:
        check_lens(image, scene.source.root if scene.source else None)
    device = pick_device(settings.backend, progress)
    earlier = folder if begun else None
    scene = posed = scene_as_read(scene, reading, earlier, settings.seed, note, progress)
    scene, stereo = seeded(scene, settings, device.type, note, progress)
    trained = scene.split(settings.test_every)[0]
    seeds = usable_seeds(scene.points, settings, note, poses_of(trained, settings.data_factor))
    check_fits(len(seeds), device)
    config = make_config(scene, seeds, settings, device_name(device), reading)
    if begun:
        check_same_seeds(folder.config, begun, config)
    views = load_split(
        scene,
        data_factor=settings.data_factor,
        test_every=settings.test_every,
        min_side=WINDOW,  # smaller views have no SSIM
        cache_dir=options.cache_dir,
        progress=progress,
    )
    frame, strays = training_frame(views[0]), stray_views(views[0])
    for name in strays:
        note(stray_note(name))
    depths, seconds = known_depths(
        scene, frame.scale, settings, device.type,
        stereo=stereo, kept=options.depths, note=note, progress=progress,
    )  # fmt: skip
    maps = {name: torch.as_tensor(depth).to(device) for name, depth in depths.items()}
    strategy = make_strategy(settings, device, maps)
    near = [frame.view(view) for view in views[0] if view.name not in strays]
    state = _state(earlier, frame.cloud_from_world(seeds), near, settings, strategy, device)
    if state.step:
        note(f"Resuming after step {state.step:,} of {settings.max_steps:,}.")
    run = TrainingRun(folder, settings, frame, state, views)
    progress("compile", 0.0)
    with gpu_memory_told(run.count):
        run.trainer.warm_up()
    # What cannot render has failed by now, and leaves no folder.
    if not begun:
        if not options.seeding_knew:
            state.watch.seconds += seconds  # the cost of growth includes finding depth
        folder.begin(config, posed if reading.refine_poses else None)
    if options.tensorboard:
        run.log_to_tensorboard()
    return run


def _check_images(scene: Scene) -> None:
    """Called before the folder is looked at, which may be the cloud's own."""
    if not scene.images:
        raise SceneNotFoundError(
            "a scene with photographs to train on",
            found=f"points alone{f' ({scene.source.points_path})' if scene.source else ''}",
            fix="Name a scene with cameras, images and photographs. To begin with the points of a "
            "scan, add them to it: splatseed upsample SCENE --cloud FILE -o OUT.",
        )


def _state(
    begun: RunFolder | None,
    seeds: PointCloud,
    views: Sequence[View],
    settings: TrainSettings,
    strategy: Strategy,
    device: torch.device,
) -> TrainState:
    """The state of a run that left a checkpoint, else the first state."""
    schedule = settings.schedule
    if begun and begun.checkpoint.is_file():
        return load_checkpoint(begun.checkpoint, strategy, schedule, device)
    gaussians, lengths = first_gaussians(seeds, views, settings)
    params = make_parameters(gaussians, device, lengths if schedule.near_depths else None)
    return TrainState(params, make_optimizers(params, schedule), strategy)


class TrainingRun:
    """A run that is ready to train.

    Args:
        folder: Where results go.
        settings: How to train.
        frame: The training frame.
        state: The run, at its first step or where it stopped.
        views: Training and test views, in the world.
    """

    def __init__(
        self,
        folder: RunFolder,
        settings: TrainSettings,
        frame: TrainingFrame,
        state: TrainState,
        views: tuple[Sequence[View], Sequence[View]],
    ) -> None:
        self.folder = folder
        self.settings = settings
        self.state = state
        self._frame = frame
        self._board: Board | None = None
        self._saved = time.monotonic()
        self._saved_step = state.step or None
        train, test = ([frame.view(view) for view in part] for part in views)
        self.trainer = Trainer(state, settings, train, test, self._on_record)

    def log_to_tensorboard(self) -> None:
        """Also write TensorBoard's log, into the run's folder."""
        self._board = Board(self.folder.tensorboard, self.state.step)
        self.folder.claim([self.folder.tensorboard])

    def count(self) -> int:
        """The number of Gaussians."""
        return len(self.state.params["means"])

    @property
    def device(self) -> str:
        """Where it trains, in words."""
        return device_name(self.trainer.device)

    @property
    def peak_gpu_bytes(self) -> int | None:
        """Most bytes that PyTorch held on the GPU so far; None on the CPU."""
        return peak_gpu_bytes(self.trainer.device)

    def train(self, on_step: Callable[[int], None] = lambda _: None) -> bool:
        """Train to the end, or until the user interrupts: then a checkpoint is saved.

        Args:
            on_step: Called with the number of steps done, after each.

        Returns:
            Whether the last step is done.

        Raises:
            OutputError: The checkpoint or the curve cannot be written.
            PointCloudError: The GPU's memory does not suffice; the checkpoint is of the last step.
        """
        with self._checkpoint_told(), gpu_memory_told(self.count):
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
        """Score the test views and write the results; the checkpoint, no longer needed, is removed.

        Args:
            score: Scores the test views.
            progress: Called with the stage and the fraction done.

        Returns:
            What is written to metrics.json.

        Raises:
            OutputError: A result cannot be written.
            PointCloudError: The GPU's memory does not suffice.
        """
        with self._checkpoint_told(), gpu_memory_told(self.count):
            progress("score", 0.0)
            scores = score(self.trainer.render, self.trainer.test_views)
            world = self._frame.gaussians_to_world(gaussians_of(self.state.params))
            scores = replace(scores, num_gaussians=len(world), model_bytes=world.num_bytes)
            result = self._result(scores)
            write_model(self.folder.gaussians, world)
            write_curve_csv(self.folder.curve_csv, self.state.records)
            write_curve_png(self.folder.curve_png, self.state.records)
            self._write_renders(progress)
            write_json(self.folder.metrics, result.to_dict())  # last: the run has finished
            self.folder.checkpoint.unlink(missing_ok=True)
        return result

    def _result(self, scores: EvalResult) -> TrainingResult:
        state, capacity = self.state, self.state.strategy.capacity
        return TrainingResult(
            scores,
            tuple(
                CurvePoint(r.step, r.seconds, r.test_psnr, r.num_gaussians, r.test_ssim)
                for r in state.records
                if r.test_psnr is not None
            ),
            steps=state.step,
            train_seconds=round(state.watch.seconds, 3),
            num_seeds=self.folder.read_config()["seeds"]["count"],
            held_by_memory_at=capacity.held_at if capacity else None,
        )

    def _on_record(self, record: Record) -> None:
        if self._board:
            self._board.add(record)
        if record.test_psnr is None:
            return
        write_curve_csv(self.folder.curve_csv, self.state.records)
        if self._saved_step is None or time.monotonic() - self._saved > SAVE_EVERY:
            self._save()

    def _save(self) -> None:
        save_checkpoint(self.folder.checkpoint, self.state)
        self._saved, self._saved_step = time.monotonic(), self.state.step

    @contextmanager
    def _checkpoint_told(self) -> Iterator[None]:
        """Say which step is saved, and how to resume, if the run is cut off."""
        try:
            yield
        except (OutputError, PointCloudError, KeyboardInterrupt) as error:
            if self._saved_step is None:
                raise
            kept = f"The run as of step {self._saved_step:,} is kept: continue it with --resume."
            if isinstance(error, KeyboardInterrupt):
                error.add_note(kept)
                raise
            raise type(error)(
                error.expected, found=error.found, fix=f"{error.fix} {kept}"
            ) from error

    def _write_renders(self, progress: Progress) -> None:
        views = self.trainer.test_views
        names = [picture_name(view.name) for view in views]
        self.folder.claim([self.folder.renders / name for name in names])
        for i, (view, name) in enumerate(zip(views, names, strict=True)):
            write_render(self.folder.renders / name, view.photograph, self.trainer.render(view))
            progress("write", (i + 1) / len(views))
