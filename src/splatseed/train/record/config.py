"""config.json: the settings of a run, for resuming and evaluating it.

Promise: a run is never resumed with other settings or other seeds than it began with.
"""

from __future__ import annotations

import dataclasses
import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.train.device import device_name
from splatseed.train.seeds import seeds_digest
from splatseed.train.settings import AS_IT_IS, Reading, TrainSettings

WHERE = {"backend"}
"""Settings that may change when a run is resumed."""
OPTIONS = {"seeding": "seeds"}
"""Command-line names of settings, where they differ."""


def make_config(
    scene: Scene,
    seeds: PointCloud,
    settings: TrainSettings,
    device: torch.device,
    reading: Reading = AS_IT_IS,
) -> dict[str, Any]:
    """The content of config.json."""
    return {
        "splatseed": _version("splatseed"),
        "scene": str(scene.source.root.resolve()) if scene.source else None,
        "points": None if reading.refine_poses else _points_path(scene),
        **dataclasses.asdict(reading),
        **dataclasses.asdict(settings),
        "device": device_name(device),
        "seeds": {"count": len(seeds), "digest": seeds_digest(seeds)},
        "versions": {
            "python": platform.python_version(),
            **{name: _version(name) for name in ("torch", "gsplat", "numba", "numpy")},
        },
    }


def resumed_settings(begun: Mapping[str, Any] | None, asked: TrainSettings) -> TrainSettings:
    """The settings of a resumed run; those asked for if there is none.

    Args:
        begun: The run's config.
        asked: The user's settings; those at their defaults take the run's values.

    Raises:
        ParameterError: A setting is neither the run's nor the default.
        SceneFormatError: The config has no settings of a run.

    A setting that did not exist in the run's version has its default, as the run was trained.
    """
    if begun is None:
        return asked
    default, changes = TrainSettings(), {}
    if "strategy" not in begun:
        raise SceneFormatError(
            "strategy in the config.json of the run",
            found="none",
            fix="Start again with --overwrite.",
        )
    for field in dataclasses.fields(TrainSettings):
        now = getattr(asked, field.name)
        then = begun.get(field.name, getattr(default, field.name))
        if field.name in WHERE or now == then:
            continue
        _check_kind(field.name, then, getattr(default, field.name))
        if now != getattr(default, field.name):
            raise _differs(field.name, then, now)
        changes[field.name] = then
    return dataclasses.replace(asked, **changes)


def resumed_reading(begun: Mapping[str, Any] | None, asked: Reading) -> Reading:
    """How a resumed run reads its scene; as asked for if there is none.

    Args:
        begun: The run's config.
        asked: What the user asks for; what is left out is as the run has it.

    Raises:
        ParameterError: The run began otherwise.
    """
    if begun is None:
        return asked
    then = Reading(**{f.name: begun.get(f.name) is True for f in dataclasses.fields(Reading)})
    for name, now in dataclasses.asdict(asked).items():
        if now and not getattr(then, name):
            raise ParameterError(
                f"no --{name.replace('_', '-')}, as when the run began",
                found="it",
                fix="Leave the option out to resume, or start again with --overwrite.",
            )
    return then


def _check_kind(name: str, then: object, default: object) -> None:
    """Refuse a setting of another type, which comparisons would fail over."""
    if isinstance(default, int) and not isinstance(then, int):
        raise SceneFormatError(
            f"{name} in the config.json of the run to be a number",
            found=repr(then)[:80],
            fix="Start again with --overwrite.",
        )


def check_same_seeds(path: Path, begun: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to resume from other points.

    Raises:
        ParameterError: The scene's points are not those that the run began with.
    """
    if begun.get("seeds") != now["seeds"]:
        raise ParameterError(
            f"the scene that the run began with ({begun.get('scene')}, says {path})",
            found=f"other points in {now['scene']}",
            fix="Name that scene, or start again with --overwrite.",
        )


def _points_path(scene: Scene) -> str | None:
    path = scene.source.points_path if scene.source else None
    return str(path.resolve()) if path else None


def _differs(name: str, then: object, now: object) -> ParameterError:
    option = OPTIONS.get(name, name.replace("_", "-"))
    return ParameterError(
        f"--{option} {then}, as when the run began",
        found=f"{now}",
        fix="Leave the option out to resume, or start again with --overwrite.",
    )


def _version(package: str) -> str | None:
    """None for a package that is run from its source tree."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None
