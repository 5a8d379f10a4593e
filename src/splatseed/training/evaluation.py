"""Scoring a trained model: which scene it belongs to, how it was trained, and what to doubt.

A run's config names its scene, the size of its photographs, its test views and its masks; a file of
another trainer needs the scene. What is resolved here is loaded and scored by ``splat.evaluate``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

from splatseed.errors import MissingDependencyError, ParameterError, SceneNotFoundError
from splatseed.io.files import StrPath
from splatseed.photos.cache import user_cache_dir
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.scores import EvalResult
from splatseed.splat.covisible import find_covisible, pixel_masks
from splatseed.splat.evaluate import OnView, TrainedModel, evaluate_model, load_model
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.lpips import load_lpips
from splatseed.training.config import has_run_masks, has_run_poses, trained_images
from splatseed.training.device import pick_device
from splatseed.training.models import config_of, model_file, near_plane_of, split_doubt
from splatseed.training.settings import Backend, TrainSettings

MINIMUM = {"data_factor": 1, "test_every": 2}
"""Lower bounds of the numbers that a run's config gives where the caller does not."""


@dataclass(frozen=True)
class Evaluation:
    """A model, the scene to score it on, and how."""

    model: Path | Gaussians  # the file of a trained model, or Gaussians in the scene's frame
    scene: Path | Scene
    data_factor: int | None  # None: as training chooses it
    test_every: int
    masks: str | None = None
    transform: str | None = None
    config: Mapping[str, Any] = field(default_factory=dict)  # of the run; empty for other models

    @classmethod
    def of(
        cls,
        model: Gaussians | StrPath,
        scene: Scene | StrPath | None = None,
        *,
        data_factor: int | None = None,
        test_every: int | None = None,
        transform: str | None = None,
        masks: str | None = None,
    ) -> Self:
        """Resolve the arguments of ``evaluate``: what is left out, a run's config gives.

        Raises:
            SceneNotFoundError: The model is missing.
            SceneFormatError: The run's config is damaged.
            ParameterError: The scene is not known or not there, or a number is out of range.
        """
        config: Mapping[str, Any] = {}
        if not isinstance(model, Gaussians):
            config, model = config_of(Path(model)), model_file(Path(model))
        numbers = {
            name: config.get(name, getattr(TrainSettings, name)) if given is None else given
            for name, given in (("data_factor", data_factor), ("test_every", test_every))
        }
        for name, value in numbers.items():
            if (name, value) != ("data_factor", None) and not (
                isinstance(value, int) and value >= MINIMUM[name]
            ):
                raise ParameterError(
                    f"`{name}` of {MINIMUM[name]} or more",
                    found=str(value),
                    fix="Leave it out for the default.",
                )
        return cls(
            model, _scene_of(model, scene, config), **numbers, transform=transform,
            masks=masks or config.get("masks"), config=config,
        )  # fmt: skip

    def load(self, backend: Backend = "auto", progress: Progress = silent) -> TrainedModel:
        """Read the model and the photographs of its test views."""
        return load_model(
            self.model,
            self.scene,
            data_factor=self.data_factor,
            test_every=self.test_every,
            transform=self.transform,
            masks=self.masks,
            trained_on=self.config.get("photographs"),
            near_plane=near_plane_of(self.config),
            device=pick_device(backend, progress),
            cache_dir=user_cache_dir(),
            progress=progress,
        )

    def doubts(self, loaded: TrainedModel) -> list[str]:
        """Describe what may make the scores wrong, or others than expected, one sentence each."""
        listed = loaded.scene.listed
        doubts = [*loaded.findings, listed.sentence if listed else ""]
        if self.config:
            doubts += self._changes(loaded.scene, [view.name for view in loaded.views])
        elif isinstance(self.model, Path):
            doubts.append(split_doubt(self.model, len(loaded.views)))
        return [doubt for doubt in doubts if doubt]

    def _changes(self, scene: Scene, tested: Sequence[str]) -> Iterator[str]:
        """Describe what is not as in the run's training, one sentence each."""
        config, trained = self.config, trained_images(self.config, scene)
        if seen := sum(name in trained for name in tested):
            every = config.get("test_every")
            by_number = self.test_every != every and scene.listed is None
            why = f"its test_every was {every}" if by_number else "the scene's split was another"
            yield f"The run was trained on {seen} of these {len(tested)} views: {why}."
        own = scene.source is not None and str(scene.source.again) == config.get("scene")
        if not own or config.get("refine_poses"):
            return  # another copy, or one that the run wrote: its files may differ
        if not has_run_poses(config, scene):
            yield "The scene's photographs or poses have changed since the run was trained."
        if self.masks == config.get("masks") and not has_run_masks(config, scene):
            yield (
                "The scene's masks have changed since the run was trained: its own scores are over "
                "other pixels."
            )

    def score(
        self,
        loaded: TrainedModel,
        *,
        lpips_weights: Path | None = None,
        on_view: OnView = lambda *_: None,
        progress: Progress = silent,
    ) -> EvalResult:
        """Score the test views.

        Without weights for LPIPS, and none given, LPIPS is left out, with the reason in the result.
        """
        lpips, reason = None, ""
        try:
            lpips = load_lpips(weights=lpips_weights)
        except (MissingDependencyError, SceneNotFoundError) as error:
            if lpips_weights is not None:
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
