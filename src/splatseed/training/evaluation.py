"""Scoring a trained model: its scene, how it was trained, and what may distort its scores.

A run's config names its scene, the size of its photographs, its test views and its masks; a file of
another trainer needs the scene. What is resolved here is loaded and scored by ``splat.evaluate``.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from splatseed.errors import (
    MissingDependencyError,
    ParameterError,
    SceneNotFoundError,
    SplatseedError,
)
from splatseed.findings import Finding
from splatseed.io import load_scene
from splatseed.io.files import StrPath, read_text
from splatseed.photos.loading import user_cache_dir
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.scores import EvalResult
from splatseed.settings import Range
from splatseed.splat.covisible import find_covisible, pixel_masks
from splatseed.splat.evaluate import OnView, TrainedModel, evaluate_model, load_model
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.lpips import load_lpips
from splatseed.text import agreeing, counted
from splatseed.training.config import (
    has_run_masks,
    has_run_poses,
    near_plane_of,
    trained_images,
    without_dropped,
)
from splatseed.training.device import pick_device
from splatseed.training.folder import config_of, model_file
from splatseed.training.request import AS_TRAINED, EvaluateRequest
from splatseed.training.settings import TrainSettings

LIMITS = {"data_factor": (int | float, Range(1)), "test_every": (int, Range(2, also=0))}
"""Of the numbers that a run's config gives where the caller does not."""


@dataclass(frozen=True)
class Evaluation:
    """A model, the scene to score it on, and the request."""

    model: Path | Gaussians  # the file of a trained model, or Gaussians in the scene's frame
    scene: Path | Scene
    request: EvaluateRequest  # with the values of the run's config, where the caller left some out
    config: Mapping[str, Any] = field(default_factory=dict)  # of the run; empty for other models
    splits: bool = False  # whether the caller chose the test views

    @classmethod
    def of(
        cls,
        model: Gaussians | StrPath,
        scene: Scene | StrPath | None = None,
        request: EvaluateRequest = AS_TRAINED,
    ) -> Self:
        """Resolve a request: a run's config gives the values that the request leaves out.

        Raises:
            SceneNotFoundError: The model is missing.
            SceneFormatError: The run's config is damaged.
            ParameterError: The scene is not known or not there, or a number is out of range.
        """
        config: Mapping[str, Any] = {}
        if not isinstance(model, Gaussians):
            config, model = config_of(Path(model)), model_file(Path(model))
        values: dict[str, Any] = {"masks": request.masks or config.get("masks")}
        for name, (kind, limits) in LIMITS.items():
            value = getattr(request, name)
            value = values[name] = config.get(name) if value is None else value
            if value is not None and not (isinstance(value, kind) and limits.contains(value, None)):
                raise ParameterError(
                    f"`{name}` {limits}", found=str(value), fix="Leave it out for the default."
                )
        splits = request.test_every is not None
        request = replace(request, **values)
        return cls(model, _scene_of(model, scene, config), request, config, splits)

    @property
    def test_every(self) -> int:
        """Every n-th image is a test view; 0: none."""
        every = self.request.test_every
        return TrainSettings.test_every if every is None else every

    def load(self, progress: Progress = silent) -> TrainedModel:
        """Read the model and the photographs of its test views.

        Photographs that the run left out are no test views.

        Raises:
            ParameterError: The run held nothing out, and the scene lists no tests.
        """
        scene = self.scene
        if not isinstance(scene, Scene):
            scene = load_scene(scene, require_points=False)
        if not self.test_every and scene.listed is None:
            every = TrainSettings.test_every
            raise ParameterError(
                "test views to score",
                found="none: nothing was held out (test_every is 0)",
                fix=f"Train with `test_every={every}`, or name a `scene` that lists test images. "
                f"Here `test_every={every}` scores photographs that the run has seen.",
            )
        return load_model(
            self.model,
            without_dropped(scene, self.config),
            data_factor=self.request.data_factor,
            test_every=self.test_every,
            transform=self.request.transform,
            masks=self.request.masks,
            exclude=self.request.exclude,
            trained_on=self.config.get("photographs"),
            near_plane=near_plane_of(self.config),
            background=self.request.background or ("black" if self.config else None),
            device=pick_device(self.request.backend, progress),
            cache_dir=user_cache_dir(),
            progress=progress,
        )

    def findings(self, loaded: TrainedModel) -> tuple[Finding, ...]:
        """Return what may make the scores wrong, or different from those that the user expects."""
        found, listed = [*loaded.findings], loaded.scene.listed
        if listed is not None:
            found.append(listed.finding(given=self.splits))
        if self.config:
            found += self._changes(loaded.scene, [view.name for view in loaded.views])
        elif isinstance(self.model, Path):
            found += split_findings(self.model, len(loaded.views))
        return tuple(found)

    def _changes(self, scene: Scene, tested: Sequence[str]) -> Iterator[Finding]:
        """Yield how views, photographs, poses and masks differ from those of the run."""
        config, trained = self.config, trained_images(self.config, scene)
        if seen := tuple(name for name in tested if name in trained):
            every = config.get("test_every")
            by_number = self.test_every != every and scene.listed is None
            why = f"its test_every was {every}" if by_number else "the scene's split was another"
            text = f"The run was trained on {len(seen)} of these {len(tested)} views: {why}."
            yield Finding("trained-test-views", text, "error", seen)
        own = str(scene.source.again) == config.get("scene")
        if not own or config.get("refine_poses"):
            return  # another copy, or one that the run wrote: its files may differ
        if not has_run_poses(config, scene):
            text = "The scene's photographs or poses have changed since the run was trained."
            yield Finding("changed-photographs", text)
        if self.request.masks == config.get("masks") and not has_run_masks(config, scene):
            text = "The scene's masks have changed since the run was trained: its own scores are "
            yield Finding("changed-masks", f"{text}over other pixels.")

    def score(
        self,
        loaded: TrainedModel,
        *,
        on_view: OnView = lambda *_: None,
        progress: Progress = silent,
    ) -> EvalResult:
        """Score the test views.

        Without weights for LPIPS, and none given, LPIPS is left out, with the reason in the result.
        """
        lpips, reason, weights = None, "", self.request.lpips_weights
        try:
            lpips = load_lpips(weights=weights)
        except (MissingDependencyError, SceneNotFoundError) as error:
            if weights is not None:
                raise
            reason = str(error)
        covisible = find_covisible(loaded.scene, self.test_every, progress)
        return evaluate_model(
            loaded,
            lpips=lpips,
            lpips_reason=reason,
            covisible=pixel_masks(covisible, loaded.views),
            on_view=on_view,
            progress=progress,
        )


def split_findings(model: Path, views: int) -> tuple[Finding, ...]:
    """Return a finding if another trainer trained on the test views, or may have.

    graphdeco's trainer and its relatives write ``cfg_args`` into the model's folder, with
    ``eval=True`` if every 8th photograph was held out.
    """
    for folder in model.resolve().parents[:4]:
        file = folder / "cfg_args"
        with suppress(OSError, SplatseedError):
            found = re.search(r"\beval=(True|False)\b", read_text(file))
            if found and found[1] == "False":
                text = f"The model was trained on all photographs, as {file} has eval=False: its "
                text += "scores are too high, since it has seen the test views."
                return (Finding("trained-test-views", text, "error"),)
            if found:
                return ()
    text = f"{model} does not record on which photographs it was trained: if the "
    text += (
        f"{counted(views, 'test view')} {agreeing(views, 'was', 'were')} among them, its scores "
    )
    text += "are too high."
    return (Finding("unknown-split", text),)


def _scene_of(
    model: Path | Gaussians, given: Scene | StrPath | None, config: Mapping[str, Any]
) -> Path | Scene:
    """The scene that is given, else the scene of the run."""
    if isinstance(given, Scene):
        return given
    if given is not None:
        return Path(given)
    trained = config.get("scene")
    if not isinstance(trained, str | Path):
        name = "Gaussians" if isinstance(model, Gaussians) else str(model)
        raise ParameterError(
            f"`scene`, as {name} does not name its scene",
            found="none",
            fix="Pass `scene=SCENE`: the scene that it was trained on.",
        )
    if not Path(trained).exists():
        raise ParameterError(
            f"the scene of the run at {trained}",
            found="none",
            fix="Pass `scene=SCENE`: where it is now.",
        )
    return Path(trained)
