"""Train and score Gaussians from Python: ``ss.train``, ``ss.Run`` and ``ss.evaluate``.

The commands ``train`` and ``evaluate`` run the same steps: ``train`` is ``prepare_training``,
``TrainingRun.train`` and ``TrainingRun.finish``; ``evaluate`` is ``Evaluation``. Needs PyTorch and
gsplat (``pip install ".[train]"``).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.io.files import StrPath, read_text
from splatseed.io.masks import with_masks
from splatseed.photos.cache import user_cache_dir
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.view import View, camera_views, view_of
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.requirements import require
from splatseed.scene import Image, Scene
from splatseed.scores import EvalResult
from splatseed.seeding.budget import in_rho, median_pixels, median_size, parse_budget
from splatseed.text import did_you_mean
from splatseed.training.folder import RunFolder
from splatseed.training.models import config_of, model_file, near_plane_of
from splatseed.training.settings import BUDGET, MIN_GAUSSIANS, Backend, TrainSettings

require("torch", "gsplat", "flip_evaluator")  # before what imports them, for one clear error

from splatseed.camera import Camera
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.formats import read_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame
from splatseed.training.device import pick_device
from splatseed.training.evaluation import Evaluation
from splatseed.training.prepare import PrepareOptions, prepare_run
from splatseed.training.run import TrainingRun
from splatseed.training.seeds import no_seeding_reason

DEFAULTS = TrainSettings(strategy="auto", seeding="advised")
"""The settings of a new run; a resumed run has its own."""


@dataclass(frozen=True)
class Run:
    """A finished training run, in its folder.

    ``ss.train`` returns one; ``ss.Run("run")`` opens the folder of an earlier one.

    Raises:
        SceneNotFoundError: ``folder`` holds no finished run.
    """

    folder: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", Path(self.folder))
        model_file(self.folder)

    @cached_property
    def config(self) -> Mapping[str, Any]:
        """The scene's path and the settings (config.json)."""
        return config_of(self.folder)

    @cached_property
    def metrics(self) -> dict[str, Any]:
        """Scores of the test views and the run's numbers (metrics.json).

        ``psnr`` and ``cc_psnr`` in dB, ``ssim``, ``flip``, ``num_gaussians``, ``train_seconds``,
        ``per_image``, ...
        """
        content: dict[str, Any] = json.loads(read_text(RunFolder(self.folder).metrics))
        return content

    @cached_property
    def gaussians(self) -> Gaussians:
        """The trained Gaussians, in the scene's frame."""
        return read_gaussians(RunFolder(self.folder).gaussians)

    def render(self, camera: Image | Camera | View) -> Float32[np.ndarray, "H W 3"]:
        """Render the Gaussians as a camera sees them.

        Args:
            camera: An image of the scene (``scene.images[0]``), a ``Camera``, or a view; without
                lens distortion.

        Returns:
            sRGB colours in [0, 1], at the camera's width and height; the background is black.
        """
        return self._renderer.color(view_of(camera))

    @cached_property
    def _renderer(self) -> ModelRenderer:
        near = near_plane_of(self.config)
        kept = self.config.get("frame") or {"origin": [0.0, 0.0, 0.0], "scale": 1.0}
        frame = TrainingFrame(np.array(kept["origin"], np.float64), float(kept["scale"]))
        if near is not None:
            frame = dataclasses.replace(frame, near=near * frame.scale)
        return ModelRenderer(self.gaussians, frame, pick_device("auto"))


def train(
    scene: Scene | StrPath,
    output: StrPath,
    *,
    budget: int | str | None = None,
    long_side: int | None = None,
    masks: str | None = None,
    refine_poses: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    tensorboard: bool = False,
    on_step: Callable[[int], None] = lambda _: None,
    note: Note = silent_note,
    progress: Progress = silent,
    **settings: Any,
) -> Run:
    """Train Gaussians on a scene and score them on its test views.

    Args:
        scene: A scene with photographs, or its path. Its points are the seeds; where they are not
            upsampled yet, method ``auto`` adds points if ``splatseed info`` would advise it
            (``seeding="scene"`` keeps them as they are).
        output: The folder of the run.
        budget: Maximum number of Gaussians: a number, or "0.25rho" for a quarter of a photograph's
            pixels at training size. By default "1rho" for strategy auto, 1,000,000 for grow and
            mcmc, and unlimited for the others.
        long_side: Instead of ``data_factor``: downsample photographs by the smallest whole factor
            that leaves at most this many pixels on their longer side.
        masks: A folder of masks, "none", or "inverted"; by default the scene's own masks.
        refine_poses: First refine the poses of a phone or SLAM; points triangulated there replace
            the scene's, unless refinement gains nothing.
        resume: Resume the run in ``output``, with its own settings; start one if there is none.
        overwrite: Replace an earlier run in ``output``.
        tensorboard: Also write a log for TensorBoard.
        on_step: Called after each step with the number of steps done.
        note: Called with notes for the user, one sentence each, such as ``print``.
        progress: Called with the name of a stage and its fraction done.
        **settings: Fields of ``TrainSettings``: ``strategy``, ``max_steps``, ``data_factor``,
            ``seed``, ``test_every``, ``backend``, ``start``, ``exposure``, ``seeding``, ...

    Raises:
        ParameterError: A setting is unknown or out of range, or differs from the resumed run's.
        OutputError: ``output`` is taken, protected or cannot be written.
        SceneNotFoundError: Fewer than half of the photographs are there.
        SceneFormatError: A camera, a photograph or the run to resume cannot be used.
        PointCloudError: Too few points, or more than fit into memory.
        KeyboardInterrupt: Ctrl-C; a checkpoint is kept, and ``resume=True`` continues from it.

    Example:
        run = ss.train(scene, "run", strategy="grow", max_steps=7000, budget="1rho")
        run.metrics["psnr"]
    """
    training = prepare_training(
        scene, output, budget=budget, long_side=long_side, masks=masks, refine_poses=refine_poses,
        resume=resume, overwrite=overwrite, tensorboard=tensorboard, note=note, progress=progress,
        **settings,
    )  # fmt: skip
    if not training.train(on_step):
        done = f"stopped after step {training.state.step}, which is kept: pass `resume=True`"
        raise KeyboardInterrupt(done)
    training.finish(partial(evaluate_views, progress=progress), progress)
    return Run(training.folder.path)


def prepare_training(
    scene: Scene | StrPath,
    output: StrPath,
    *,
    budget: int | str | None = None,
    long_side: int | None = None,
    masks: str | None = None,
    refine_poses: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    tensorboard: bool = False,
    note: Note = silent_note,
    progress: Progress = silent,
    **settings: Any,
) -> TrainingRun:
    """Prepare a run: the first step of ``train``, which see for arguments and errors."""
    folder = RunFolder(Path(output))
    resumes = resume and folder.is_run
    asked = _settings_from(settings, resumes=resumes)
    if asked.start and (refine_poses or "seeding" in settings):
        other = "refine_poses" if refine_poses else "seeding"
        raise ParameterError(f"`start` or `{other}`", found="both", fix="Leave one out.")
    if not isinstance(scene, Scene):
        points_alone = settings.get("seeding") == "scene" and not refine_poses and not asked.start
        scene = load_scene(scene, require_points=points_alone)
    scene = with_masks(scene, masks)
    for warning in scene.findings:
        note(warning)
    if scene.listed is not None:
        note(scene.listed.sentence)
    asked = _sized(asked, scene, long_side, folder if resumes else None, note)
    asked = _within_budget(asked, budget, scene, note)
    if settings.get("seeding") == "auto" and (why := no_seeding_reason(scene, asked)):
        note(f"`seeding='auto'` has no effect: {why}.")
    explicit = {*settings}
    explicit |= {"cap_max"} if budget is not None else set()
    explicit |= {"data_factor"} if long_side is not None else set()
    return prepare_run(
        scene,
        output,
        asked,
        PrepareOptions(
            resume=resume,
            overwrite=overwrite,
            refine_poses=refine_poses,
            tensorboard=tensorboard,
            explicit=explicit,
            cache_dir=user_cache_dir(),
        ),
        note=note,
        progress=progress,
    )


def evaluate(
    model: Run | Gaussians | StrPath,
    scene: Scene | StrPath | None = None,
    *,
    data_factor: int | None = None,
    test_every: int | None = None,
    transform: str | None = None,
    masks: str | None = None,
    lpips_weights: Path | None = None,
    backend: Backend = "auto",
    note: Note = silent_note,
    progress: Progress = silent,
) -> EvalResult:
    """Score Gaussians on the test views of a scene.

    Args:
        model: A run, Gaussians in the scene's frame, or the path of a run or of a file of any
            trainer (.ply, .spz, .sog, .splat).
        scene: The scene, or its path; a run knows its own.
        data_factor: Divide the width and height of the photographs by this; by default as the run
            was trained, else to at most 1600 pixels a side.
        test_every: Every n-th image, sorted by name, is a test view; by default as the run was
            trained, else 8.
        transform: From the scene's frame to the model's, if its trainer normalised the scene: a
            file, "gsplat", "flipped" (y and z negated), or "none" to skip the check that they
            agree.
        masks: A folder of masks, "none", or "inverted"; by default the run's, else the scene's.
        lpips_weights: VGG's weights for LPIPS; by default from PyTorch's cache. Without weights
            LPIPS is None.
        backend: Where to render.
        note: Called with notes for the user, one sentence each.
        progress: Called with the name of a stage and its fraction done.

    Returns:
        Means over the test views, as attributes (``psnr`` in dB, ``cc_psnr``, ``covisible_psnr``,
        ``ssim``, ``flip``, ``lpips``) and in ``to_dict()``; per view in ``per_image``.

    Raises:
        SceneNotFoundError: The model, the scene or its photographs are missing.
        SceneFormatError: One of them is damaged, or the Gaussians are not where the scene's points
            are.
        ParameterError: An argument is out of range.
    """
    evaluation = Evaluation.of(
        model.folder if isinstance(model, Run) else model, scene, data_factor=data_factor,
        test_every=test_every, transform=transform, masks=masks,
    )  # fmt: skip
    loaded = evaluation.load(backend, progress)
    for doubt in evaluation.doubts(loaded):
        note(doubt)
    return evaluation.score(loaded, lpips_weights=lpips_weights, progress=progress)


def _settings_from(given: Mapping[str, Any], *, resumes: bool) -> TrainSettings:
    """The settings of keyword arguments; others are the defaults, of a resumed run its own."""
    known = [each.name for each in dataclasses.fields(TrainSettings)]
    for name in given:
        if name not in known:
            raise ParameterError(
                "arguments of train, or fields of TrainSettings",
                found=name,
                fix=f"{did_you_mean(name, known)}The fields are {', '.join(known)}.",
            )
    start = given.get("start")
    if start is not None:
        given = {**given, "start": str(model_file(Path(start)).resolve())}
    return dataclasses.replace(TrainSettings() if resumes else DEFAULTS, **given)


def _sized(
    settings: TrainSettings,
    scene: Scene,
    long_side: int | None,
    resumed: RunFolder | None,
    note: Note,
) -> TrainSettings:
    """The settings with the factor that ``long_side``, the resumed run or the default implies."""
    if long_side is None:
        if settings.data_factor is None and resumed is not None:
            kept = resumed.read_config().get("data_factor")
            return dataclasses.replace(settings, data_factor=kept if isinstance(kept, int) else 1)
        return settings.with_data_factor(scene.images, note)
    if settings.data_factor is not None:
        raise ParameterError("`long_side` or `data_factor`", found="both", fix="Leave one out.")
    if long_side < 1:
        raise ParameterError("`long_side` of 1 or more", found=str(long_side), fix="Try 800.")
    factor = factor_for_size(scene.images, long_side) if scene.images else 1
    return dataclasses.replace(settings, data_factor=factor)


def _within_budget(
    settings: TrainSettings, budget: int | str | None, scene: Scene, note: Note
) -> TrainSettings:
    """The settings with the number of Gaussians that the budget allows in this scene."""
    chosen = settings.strategy == "auto" and settings.cap_max is None
    if budget is None and not (chosen and scene.images):
        return settings
    views = camera_views(scene.images, settings.factor)
    pixels = median_pixels(views) if views else 0
    size = f"{median_size(views)} pixels, a photograph's size in training" if views else ""
    if budget is not None:
        cap = parse_budget(budget, pixels)
        if cap < MIN_GAUSSIANS:
            expected = f"`budget` of {MIN_GAUSSIANS} Gaussians or more"
            raise ParameterError(expected, found=str(budget), fix="Try 0.25rho.")
        if in_rho(budget):
            note(f"At most {cap:,} Gaussians: {budget} of {size}.")
        return dataclasses.replace(settings, cap_max=cap)
    cap = max(2, min(BUDGET, round(pixels)))
    reason = f"{'1rho' if pixels <= BUDGET else 'fewer than 1rho'} of {size}"
    if settings.start:  # a merge of two may be larger, and must not be thinned unless asked for
        number = len(read_gaussians(Path(settings.start)))
        cap, reason = (number, "as many as it starts with") if number > cap else (cap, reason)
    note(f"At most {cap:,} Gaussians: {reason}; `budget` sets another number.")
    return dataclasses.replace(settings, cap_max=cap)
