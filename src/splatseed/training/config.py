"""The config of a run (config.json): its scene and settings, and what a resumed run must repeat.

Promise: an interrupted run resumes only with its own settings, seeds, photographs and poses.
"""

from __future__ import annotations

import dataclasses
import math
import platform
from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import Any

from splatseed.checkup.wrong_poses import leave_out
from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.exclusion import exclude
from splatseed.io.masks import mask_choice, masks_digest, with_masks
from splatseed.io.photograph import photographs_digest
from splatseed.io.staging import write_json
from splatseed.requirements import version_of
from splatseed.scene import Scene
from splatseed.splat.training_frame import TrainingFrame
from splatseed.training.folder import RunFolder
from splatseed.training.settings import TrainSettings

_PLACES = ("scene", "points")
"""The scene's paths: a resumed run's scene may have moved, but must have the same content."""


def make_config(
    scene: Scene,
    initial: Mapping[str, Any],
    settings: TrainSettings,
    device: str,
    frame: TrainingFrame | None = None,
    *,
    refine_poses: bool = False,
    left_out: Mapping[str, Collection[str]] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the content of config.json.

    ``initial`` are the facts of the seeds or of the start. ``left_out`` are images that the run
    leaves out: "dropped" for their poses, "excluded" before, by patterns "exclude" or otherwise.
    """
    source = scene.source
    points = None if refine_poses else source.points_path
    config = {
        "splatseed": version_of("splatseed"),
        "scene": str(source.again) if source.again else None,
        "points": str(points.resolve()) if points else None,
        "refine_poses": refine_poses,
        "masks": mask_choice(scene),
        "mask_files": masks_digest(scene),
        **dataclasses.asdict(settings),
        "device": device,
        "seeds": dict(initial),
        "photographs": photographs_digest(scene),
        "split": _names_of_parts(scene, settings),
        **{name: sorted(names) for name, names in left_out.items()},
        "versions": {
            "python": platform.python_version(),
            **{name: version_of(name) for name in ("torch", "gsplat", "numba", "numpy")},
        },
    }
    if frame is not None:  # in which the run is rendered; lengths are the scene's
        config["near_plane"] = frame.near / frame.scale
        config["frame"] = {"origin": frame.origin.tolist(), "scale": frame.scale}
    return config


def _names_of_parts(scene: Scene, settings: TrainSettings) -> dict[str, list[str]]:
    parts = zip(("train", "test"), scene.split(settings.test_every), strict=True)
    return {part: [image.name for image in images] for part, images in parts}


def resumed_settings(
    config: Mapping[str, Any],
    settings: TrainSettings,
    named: Collection[str] = (),
    *,
    refine_poses: bool,
) -> tuple[TrainSettings, bool]:
    """Return the settings of the run to resume, and whether it refined poses.

    Settings that are neither ``named`` nor differ from their defaults are the run's; others must
    equal the run's. Only the backend may change.

    Raises:
        ParameterError: A setting differs from the run's.
        SceneFormatError: The config is damaged, or another version of splatseed started the run.
    """
    _check_version(config)
    default = {**dataclasses.asdict(TrainSettings()), "refine_poses": False}
    now = {**dataclasses.asdict(settings), "refine_poses": refine_poses}
    then: dict[str, Any] = {name: config.get(name) for name in default if name != "backend"}
    for name, value in then.items():
        if now[name] != value and (name in named or now[name] != default[name]):
            raise ParameterError(
                f"`{name}={value!r}`, as when the run began",
                found=f"`{name}={now[name]!r}`",
                fix="Leave it out to resume, or start again with `overwrite=True`.",
            )
    refined = then.pop("refine_poses") is True
    try:
        return dataclasses.replace(settings, **then), refined
    except ParameterError as error:
        raise SceneFormatError(
            f"{error.expected} in the config.json of the run",
            found=error.found,
            fix="Start again with `overwrite=True`.",
        ) from None


def _check_version(config: Mapping[str, Any]) -> None:
    then, now = config.get("splatseed"), version_of("splatseed")
    if then != now:
        raise SceneFormatError(
            f"a run that this version of splatseed ({now}) started, to resume it",
            found=f"one of version {then}",
            fix="Start again with `overwrite=True`, or resume it with that version.",
        )


def has_run_poses(config: Mapping[str, Any], scene: Scene) -> bool:
    """Whether a scene has the photographs and poses that a run was trained with."""
    return config.get("photographs") == photographs_digest(without_dropped(scene, config))


def without_dropped(scene: Scene, config: Mapping[str, Any]) -> Scene:
    """Return a scene without the images that a run left out, and report them in it."""
    dropped, scene = config.get("dropped"), exclude(scene, excluded_names(config, scene))
    scene, findings = leave_out(scene, dropped if isinstance(dropped, list) else ())
    return scene.replace(findings=(*scene.findings, *findings)) if findings else scene


def excluded_names(config: Mapping[str, Any], scene: Scene) -> list[str]:
    """Return the images of a scene that a run left out from the beginning."""
    names = config.get("excluded")
    return [name for name in names if name in scene] if isinstance(names, list) else []


def check_same_input(folder: RunFolder, config: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to resume from other seeds, or another start, than those of the run.

    ``config`` is the run's, ``now`` what its config would be.
    """
    if config.get("seeds") != now["seeds"]:
        found = f"Gaussians in {now['start']}" if now["start"] else f"points in {now['scene']}"
        raise another_scene(folder, config, found)
    if config.get("photographs") != now["photographs"]:
        raise another_scene(folder, config, f"photographs or poses in {now['scene']}")


def near_plane_of(config: Mapping[str, Any]) -> float | None:
    """Return the near plane of a run's training, in scene units; None without one."""
    near = config.get("near_plane")
    return float(near) if isinstance(near, float) and 0 < near < math.inf else None


def trained_images(config: Mapping[str, Any], scene: Scene) -> Collection[str]:
    """Return the names of the images that a run was trained on.

    Older versions did not record them: then they follow from the scene as it is now.
    """
    if isinstance(split := config.get("split"), dict):
        return frozenset(split.get("train", ()))
    every = config.get("test_every")
    return {im.name for im in scene.split(every)[0]} if isinstance(every, int) else ()


def update_places(folder: RunFolder, config: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Record where the scene of a resumed run lies now, so that evaluate and view find it."""
    moved = {name: now[name] for name in _PLACES if config.get(name) != now[name]}
    if moved:
        write_json(folder.config, {**config, **moved})


def with_masks_of(scene: Scene, config: Mapping[str, Any]) -> Scene:
    """Give the scene the masks of the run to resume; masks that the user chose must be the same."""
    now, then = mask_choice(scene), config.get("masks")
    if now is None and isinstance(then, str):
        return with_masks(scene, then)
    if now != then:
        raise ParameterError(
            f"`masks={then!r}`, as when the run began",
            found=str(now),
            fix="Leave it out to resume, or start again with `overwrite=True`.",
        )
    return scene


def check_same_scene(
    folder: RunFolder, config: Mapping[str, Any], scene: Scene, settings: TrainSettings
) -> None:
    """Refuse to resume with other masks, training or test images."""
    found = "" if has_run_masks(config, scene) else "masks"
    if config.get("split") != _names_of_parts(without_dropped(scene, config), settings):
        listed = f" (by its {scene.listed.origin})" if scene.listed else ""
        found = f"training or test images{listed}"
    if found:
        where = scene.source.root or "the scene"
        raise another_scene(folder, config, f"{found} in {where}")


def has_run_masks(config: Mapping[str, Any], scene: Scene) -> bool:
    """Whether a scene's masks are those that a run was trained with, as far as it recorded them."""
    now = masks_digest(scene)
    return bool(config.get("mask_files", now) == now)


def another_scene(folder: RunFolder, config: Mapping[str, Any], found: str) -> ParameterError:
    """Return the error for a scene that is not the run's."""
    return ParameterError(
        f"the scene of the run ({config.get('scene')}, by {folder.config})",
        found=f"other {found}",
        fix="Name that scene, or start again with `overwrite=True`.",
    )
