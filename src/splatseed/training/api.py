"""Train and score Gaussians from Python: ``ss.train``, ``ss.Run`` and ``ss.evaluate``.

The commands ``train`` and ``evaluate`` run the same steps: ``train`` is ``prepare_training``,
``TrainingRun.train`` and ``TrainingRun.finish``; ``evaluate`` is ``Evaluation``. Needs PyTorch and
gsplat (``pip install ".[train]"``).
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.io.exclusion import exclude
from splatseed.io.files import StrPath, read_text
from splatseed.io.masks import with_masks
from splatseed.io.regions import parse_region
from splatseed.io.staging import reserved
from splatseed.photos.loading import user_cache_dir
from splatseed.photos.sizes import factor_for_side
from splatseed.photos.view import View, camera_views, view_of
from splatseed.progress import Note, Progress, log_note, silent, silent_note
from splatseed.requirements import require
from splatseed.scene import MIN_HELD_OUT, Image, Scene
from splatseed.scores import EvalResult
from splatseed.seeding.budget import in_rho, median_pixels, median_size, parse_budget
from splatseed.settings import change_settings
from splatseed.text import agreeing, counted
from splatseed.training.config import excluded_names, near_plane_of
from splatseed.training.folder import RunFolder, config_of, model_file
from splatseed.training.request import EvaluateRequest, TrainRequest
from splatseed.training.schedule import default_steps
from splatseed.training.settings import BUDGET, MIN_GAUSSIANS, TrainSettings
from splatseed.training.traits import AUTO

require("torch", "gsplat", "flip_evaluator")  # before what imports them, for one clear error

from splatseed.camera import Camera
from splatseed.findings import Finding
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.formats import read_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame
from splatseed.training.device import pick_device
from splatseed.training.evaluation import Evaluation
from splatseed.training.prepare import prepare_run
from splatseed.training.run import TrainingRun
from splatseed.training.seeds import no_seeding_reason


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
        ``per_image``, ...; scores are None if no photograph was held out.
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
    on_step: Callable[[int], None] = lambda _: None,
    note: Note = log_note,
    progress: Progress = silent,
    **options: Any,
) -> Run:
    """Train Gaussians on a scene and score them on its test views, which few photographs lack.

    Args:
        scene: A scene with photographs, or its path. Its points are the seeds; where they are not
            upsampled yet, method ``auto`` adds points if ``splatseed info`` would advise it
            (``seeding="scene"`` keeps them as they are).
        output: The folder of the run.
        on_step: Called after each step with the number of steps done.
        note: Called with each finding for the user, such as ``print``; by default they are logged.
        progress: Called with the name of a stage and its fraction done.
        **options: Fields of ``TrainSettings``: ``strategy``, ``max_steps``, ``data_factor``,
            ``seed``, ``test_every``, ``backend``, ``start``, ``exposure``, ``seeding``, ...; and of
            ``TrainRequest``: ``budget`` (a number, or "0.25rho" for a quarter of a photograph's
            pixels), ``long_side`` instead of ``data_factor``, ``masks`` (a folder, "none",
            "inverted", "alpha"), ``exclude`` (a list of names, of patterns such as "IMG_00*", or of
            .txt files with them), ``refine_poses``, ``resume``, ``overwrite``, ``tensorboard``.

    Raises:
        ParameterError: An option is unknown or out of range, or differs from the resumed run's.
        OutputError: ``output`` is taken, protected or cannot be written, or another process
            writes it.
        SceneNotFoundError: Fewer than half of the photographs are there.
        SceneFormatError: A camera, a photograph or the run to resume cannot be used.
        PointCloudError: Too few points, or more than fit into memory.
        KeyboardInterrupt: Ctrl-C; a checkpoint is kept, and ``resume=True`` continues from it.

    Example:
        run = ss.train(scene, "run", strategy="grow", max_steps=7000, budget="1rho")
        run.metrics["psnr"]
    """
    request = TrainRequest.of(options)
    with reserved(Path(output)):
        training = prepare_training(scene, output, request, note=note, progress=progress)
        if not training.train(on_step):
            done = f"stopped after step {training.state.step}, which is kept: pass `resume=True`"
            raise KeyboardInterrupt(done)
        training.finish(partial(evaluate_views, progress=progress), progress)
    return Run(training.folder.path)


def prepare_training(
    scene: Scene | StrPath,
    output: StrPath,
    request: TrainRequest,
    *,
    note: Note = silent_note,
    progress: Progress = silent,
) -> TrainingRun:
    """Prepare a run: the first step of ``train``, which see for arguments and errors."""
    folder = RunFolder(Path(output))
    resumed = folder if request.resume and folder.is_run else None
    settings = _named_settings(request, resumes=resumed is not None)
    if not isinstance(scene, Scene):
        points_alone = "seeding" in request.named and settings.seeding == "scene"
        points_alone &= not request.refine_poses and not settings.start
        scene = load_scene(scene, require_points=points_alone)
    patterns: Sequence[str] = request.exclude
    if resumed is not None and not patterns:
        patterns = excluded_names(resumed.read_config(), scene)
    scene = with_masks(exclude(scene, patterns), request.masks)
    for finding in scene.findings:
        note(finding)
    if scene.listed is not None:
        note(scene.listed.finding(given="test_every" in request.named))
    if resumed is None and "test_every" not in request.named:
        settings = _with_default_split(settings, scene, note)
    if resumed is None and "max_steps" not in request.named:
        settings = _with_default_steps(settings, scene, note)
    settings = _sized(settings, scene, request.long_side, resumed, note)
    settings = _within_budget(settings, request.budget, scene, note)
    adds_points = settings.region is not None or settings.seeding == "auto"
    if adds_points and (why := no_seeding_reason(scene, settings)):
        given = "seeding='auto'" if settings.region is None else "region"
        note(Finding("unused-setting", f"`{given}` has no effect: {why}."))
    named = {*request.named}
    named |= {"cap_max"} if request.budget is not None else set()
    named |= {"data_factor"} if request.long_side is not None else set()
    return prepare_run(
        scene, output, settings, request,
        named=named, cache_dir=user_cache_dir(), note=note, progress=progress,
    )  # fmt: skip


def evaluate(
    model: Run | Gaussians | StrPath,
    scene: Scene | StrPath | None = None,
    *,
    note: Note = log_note,
    progress: Progress = silent,
    **options: Any,
) -> EvalResult:
    """Score Gaussians on the test views of a scene.

    Args:
        model: A run, Gaussians in the scene's frame, or the path of a run or of a file of any
            trainer (.ply, .spz, .sog, .splat).
        scene: The scene, or its path; a run knows its own.
        note: Called with each finding for the user; by default they are logged.
        progress: Called with the name of a stage and its fraction done.
        **options: Fields of ``EvaluateRequest``: ``data_factor`` and ``test_every``, by default as
            the run was trained; ``transform`` from the scene's frame to the model's (a file,
            "gsplat", "flipped", "turned", or "none" to skip the check that they agree); ``masks``
            (a folder, "none", "inverted", "alpha"); ``exclude``, test views to leave out;
            ``background`` ("black", "white" or "R,G,B", by default what the model's trainer
            recorded, else black); ``lpips_weights``, a file, without which, here or in PyTorch's
            cache, LPIPS is None; ``backend``.

    Returns:
        Means over the test views, as attributes (``psnr`` in dB, ``cc_psnr``, ``covisible_psnr``,
        ``ssim``, ``flip``, ``lpips``) and in ``to_dict()``; per view in ``per_image``.

    Raises:
        SceneNotFoundError: The model, the scene or its photographs are missing.
        SceneFormatError: One of them is damaged, or the Gaussians are not where the scene's points
            are.
        ParameterError: An option is unknown or out of range.
    """
    request = change_settings(EvaluateRequest(), "evaluate", options)
    evaluation = Evaluation.of(model.folder if isinstance(model, Run) else model, scene, request)
    loaded = evaluation.load(progress)
    for finding in evaluation.findings(loaded):
        note(finding)
    return evaluation.score(loaded, progress=progress)


def _named_settings(request: TrainRequest, *, resumes: bool) -> TrainSettings:
    """Return the request's settings; for a run that resumes, those alone that the caller named."""
    settings = request.settings
    if resumes:
        given = {name: getattr(settings, name) for name in request.named}
        settings = dataclasses.replace(TrainSettings(), **given)
    if settings.region is not None:
        parse_region(settings.region)  # before any work
        if "seeding" in request.named and settings.seeding == "scene":
            found, fix = "`seeding='scene'`", "Leave one out: it adds no points."
            raise ParameterError("`region` with points to add there", found=found, fix=fix)
        if Path(settings.region).is_file():  # to resume from another folder
            settings = dataclasses.replace(settings, region=str(Path(settings.region).resolve()))
    if settings.start is None:
        return settings
    others = ["refine_poses"] * request.refine_poses
    others += [name for name in ("seeding", "region") if name in request.named]
    if others:
        raise ParameterError(f"`start` or `{others[0]}`", found="both", fix="Leave one out.")
    return dataclasses.replace(settings, start=str(model_file(Path(settings.start)).resolve()))


def _with_default_split(settings: TrainSettings, scene: Scene, note: Note) -> TrainSettings:
    """The settings, with nothing held out of few photographs, unless the scene lists tests."""
    chosen = scene.listed is not None or settings.test_every != TrainSettings.test_every
    if chosen or scene.default_test_every == settings.test_every or not scene.images:
        return settings
    count = scene.num_viewpoints
    faces = f", from {count} viewpoints," if count < len(scene.images) else ""
    text = f"All {len(scene.images)} photographs{faces} are trained on: of fewer than "
    text += f"{MIN_HELD_OUT}, none is held out by default, so nothing is scored on unseen "
    text += "photographs."
    fix = f"`test_every={settings.test_every}` holds some out, or list them (docs/formats.md)."
    note(Finding("nothing-held-out", text, "info", fix=fix))
    return dataclasses.replace(settings, test_every=scene.default_test_every)


def _with_default_steps(settings: TrainSettings, scene: Scene, note: Note) -> TrainSettings:
    """The settings, with fewer steps for few photographs, unless they are to be 3DGS's."""
    count = len(scene.split(settings.test_every)[0])
    steps = default_steps(count)
    if steps == settings.max_steps or settings.as_3dgs:
        return settings
    text = f"{counted(count, 'photograph')} {agreeing(count, 'is', 'are')} trained on for "
    text += f"{steps:,} steps: more would fit them better, but not other views."
    fix = f"`max_steps={settings.max_steps}` takes more."
    note(Finding("fewer-steps", text, "info", fix=fix))
    return dataclasses.replace(settings, max_steps=steps)


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
            return dataclasses.replace(
                settings, data_factor=kept if isinstance(kept, int | float) else None
            )
        return settings.with_data_factor(scene.images, note)
    if settings.data_factor is not None:
        raise ParameterError("`long_side` or `data_factor`", found="both", fix="Leave one out.")
    if long_side < 1:
        raise ParameterError("`long_side` of 1 or more", found=str(long_side), fix="Try 800.")
    factor = factor_for_side(scene.images, long_side) if scene.images else 1
    return dataclasses.replace(settings, data_factor=factor)


def _within_budget(
    settings: TrainSettings, budget: int | str | None, scene: Scene, note: Note
) -> TrainSettings:
    """The settings with the number of Gaussians that the budget allows in this scene."""
    chosen = settings.strategy == AUTO and settings.cap_max is None
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
            text = f"At most {cap:,} Gaussians: {budget} of {size}."
            note(Finding("budget", text, "info"))
        return dataclasses.replace(settings, cap_max=cap)
    cap = max(2, min(BUDGET, round(pixels)))
    reason = f"{'1rho' if pixels <= BUDGET else 'fewer than 1rho'} of {size}"
    if settings.start:  # a merge of two may be larger, and must not be thinned unless asked for
        number = len(read_gaussians(Path(settings.start)))
        cap, reason = (number, "as many as it starts with") if number > cap else (cap, reason)
    text = f"At most {cap:,} Gaussians: {reason}; `budget` sets another number."
    note(Finding("budget", text, "info"))
    return dataclasses.replace(settings, cap_max=cap)
