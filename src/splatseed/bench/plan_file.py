"""Read and write plans as TOML.

``read_plan`` inverts ``plan_text``. An unknown key or a value of the wrong type is an error. Paths
are relative to the file.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from splatseed.bench.plan import SHARED, Plan
from splatseed.bench.scenes import DEMO, PlannedScene
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import StrPath, read_text
from splatseed.methods import absolute_place
from splatseed.settings import describe_type, fits
from splatseed.training.settings import TrainSettings

PLAN = "plan.toml"
"""The name of the plan in a benchmark's folder."""
_FILES = ("path", "depth", "cloud")
"""Keys of a scene that are paths."""
_HINTS: dict[str, Any] = {
    **get_type_hints(Plan), **get_type_hints(TrainSettings),
    "scenes": tuple[dict, ...],  # type: ignore[type-arg]  # their keys are checked apart
    "budgets": tuple[str | float, ...], "parameters": dict,
}  # fmt: skip
KINDS: Mapping[str, Any] = {
    name: _HINTS[name]
    for field in fields(Plan)
    for name in (SHARED if field.name == "training" else [field.name])
}
"""The types of a plan's keys: the fields of ``Plan``, with those of ``training`` beside them."""


def read_plan(path: StrPath, folder: Path | None = None) -> Plan:
    """Read a plan.

    Args:
        path: The TOML file.
        folder: The folder to which its paths are relative; by default the file's.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: The file is no TOML, or a key or a value is invalid.
    """
    path = Path(path)
    content = _read_toml(path)
    _check(path, content, KINDS)
    methods = content.get("parameters", {})
    _check(path, methods, dict.fromkeys(methods, dict), "parameters.")
    values: dict[str, Any]
    values = {key: tuple(v) if isinstance(v, list) else v for key, v in content.items()}
    folder = folder or path.parent
    values["scenes"] = tuple(_scene(path, folder, scene) for scene in content.get("scenes", ()))
    if "methods" in values:
        values["methods"] = tuple(absolute_place(name, path.parent) for name in values["methods"])
    values["parameters"] = {absolute_place(name, path.parent): v for name, v in methods.items()}
    try:
        training = TrainSettings(**{name: values.pop(name) for name in SHARED if name in values})
        return Plan(**values, training=training)
    except ParameterError as error:
        expected = f"{error.expected} in {path}"
        raise SceneFormatError(expected, found=error.found, fix=error.fix) from None


def plan_text(plan: Plan) -> str:
    """Write a plan as TOML with absolute paths."""
    lines = []
    for key in KINDS:
        value = getattr(plan.training if key in SHARED else plan, key)
        if key not in {"scenes", "parameters"} and value is not None:
            lines.append(f"{key} = {_value(value)}")
    for scene in plan.scenes:
        values = asdict(scene)
        for key in _FILES:
            if values[key] and values[key] != DEMO:
                values[key] = str(Path(values[key]).absolute())
        pairs = [f"{key} = {_value(value)}" for key, value in values.items() if value]
        lines += ["", "[[scenes]]", *pairs]
    for method, parameters in plan.parameters.items():
        pairs = [f"{_key(name)} = {_value(value)}" for name, value in parameters.items()]
        lines += ["", f"[parameters.{_key(method)}]", *pairs]
    return "\n".join(lines) + "\n"


def _read_toml(path: Path) -> dict[str, Any]:
    fix = "splatseed bench --scenes SCENE --dry-run prints one."
    try:
        return tomllib.loads(read_text(path))
    except FileNotFoundError:
        raise SceneNotFoundError(f"a plan at {path}", found="no such file", fix=fix) from None
    except (OSError, ValueError) as error:
        found = getattr(error, "strerror", None) or str(error)
    raise SceneFormatError(f"{path} to be a plan in TOML", found=found, fix=fix)


def _check(
    path: Path, content: Mapping[str, object], hints: Mapping[str, Any], within: str = ""
) -> None:
    """Refuse unknown keys, and values of the wrong type."""
    for key, value in content.items():
        if key not in hints:
            known = f"a key of a plan in {path} ({', '.join(hints)})"
            raise SceneFormatError(known, found=repr(within + key), fix="Check its spelling.")
        hint, listed = hints[key], get_origin(hints[key]) is tuple
        kind = get_args(hint)[0] if listed else hint
        parts = value if listed and isinstance(value, list) else [value]
        if isinstance(value, list) != listed or not all(fits(part, kind) for part in parts):
            expected = f"{'a list, each item ' if listed else ''}{describe_type(kind)}"
            raise SceneFormatError(
                f"{within}{key} = {expected} in {path}", found=repr(value), fix="Correct the plan."
            )


def _scene(path: Path, folder: Path, content: Mapping[str, Any]) -> PlannedScene:
    _check(path, content, get_type_hints(PlannedScene), "scenes.")
    if not content.get("path"):
        expected = f"scenes.path for every scene in {path}"
        raise SceneFormatError(expected, found="none", fix="Add the scene's folder.")
    named = {key: content[key] for key in _FILES if content.get(key) and content[key] != DEMO}
    return PlannedScene(**{**content, **{key: str(folder / file) for key, file in named.items()}})


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # TOML has the escapes of JSON, and requires one for DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_value, value))}]"
    return repr(value)


def _key(name: str) -> str:
    return name if name.replace("_", "").isalnum() and name.isascii() else _value(name)
