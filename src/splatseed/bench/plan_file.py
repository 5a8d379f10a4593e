"""Plans as TOML files, and ready-made ones: the paper's data sets, and two that a laptop can run.

``read_plan`` reads what ``plan_text`` writes back as the same plan; a misspelt key, or a value of
the wrong kind, is an error. Paths in a file are relative to it.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from importlib.resources import files
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

from splatseed.bench.plan import SHARED, Plan
from splatseed.bench.scenes import DEMO, PlannedScene
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import read_text
from splatseed.literal import quoted
from splatseed.train.settings import TrainSettings

PresetName = Literal["mipnerf360", "replica", "laptop", "quick"]
PRESETS: tuple[PresetName, ...] = get_args(PresetName)
PLAN = "plan.toml"
"""The name of the plan in the folder of a benchmark."""
_FILES = ("path", "depth", "cloud")
"""Keys of a scene that are paths, relative to the plan's file."""


_HINTS = {**get_type_hints(Plan), **get_type_hints(TrainSettings)}
KINDS: Mapping[str, object] = {
    name: _HINTS[name]
    for each in fields(Plan)
    for name in (SHARED if each.name == "training" else [each.name])
}
"""The type of each key of a plan: those of ``Plan``, except that ``training`` is flat."""
_WORDS = {str: "text", int: "a whole number", float: "a number", bool: "true or false",
          dict: "a table"}  # fmt: skip


def read_plan(path: Path, folder: Path | None = None) -> Plan:
    """Read a plan; its paths are relative to a folder, the file's own when left out.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no TOML, or a key or a value is not one of a plan.
    """
    content = _read_toml(path)
    _check(path, content, KINDS)
    methods = content.get("parameters", {})
    _check(path, methods, dict.fromkeys(methods, dict), "parameters.")
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in content.items()
    }
    values["scenes"] = tuple(
        _scene(path, folder or path.parent, each) for each in content.get("scenes", ())
    )
    try:
        training = TrainSettings(**{name: values.pop(name) for name in SHARED if name in values})
        return Plan(**values, training=training)
    except ParameterError as error:
        raise SceneFormatError(
            f"{error.expected} in {path}", found=error.found, fix="Correct the plan."
        ) from None


def plan_text(plan: Plan) -> str:
    """A plan as TOML, with absolute paths, so that the text can be kept anywhere."""
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
        told = [f"{key} = {_value(value)}" for key, value in values.items() if value]
        lines += ["", "[[scenes]]", *told]
    for method, parameters in plan.parameters.items():
        told = [f"{_key(name)} = {_value(value)}" for name, value in parameters.items()]
        lines += ["", f"[parameters.{_key(method)}]", *told]
    return "\n".join(lines) + "\n"


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(read_text(path))
    except FileNotFoundError:
        raise SceneNotFoundError(
            f"a plan at {path}",
            found="no such file",
            fix="Check the path, or have one written: splatseed bench --scenes SCENE --dry-run > "
            f"{quoted(path)}",
        ) from None
    except (OSError, ValueError) as error:
        found = getattr(error, "strerror", None) or str(error)
    raise SceneFormatError(
        f"{path} to be a plan in TOML", found=found, fix="splatseed bench --dry-run prints one."
    )


def _check(
    path: Path, content: Mapping[str, object], hints: Mapping[str, object], within: str = ""
) -> None:
    """Refuse keys and values of other kinds than a plan's; true and false are no numbers."""
    for key, value in content.items():
        if key not in hints:
            raise SceneFormatError(
                f"a key of a plan in {path} ({', '.join(hints)})",
                found=repr(within + key),
                fix="Check its spelling.",
            )
        kind, listed = _kind(hints[key])
        types: tuple[type, ...] = (int, float) if kind is float else (kind,)
        types = (str, int, float) if key == "budgets" else types
        parts = value if listed and isinstance(value, list) else [value]
        if isinstance(value, list) != listed or any(type(part) not in types for part in parts):
            words = f"a list, each {_WORDS[kind]}" if listed else _WORDS[kind]
            raise SceneFormatError(
                f"{within}{key} in {path} to be {words}",
                found=f"{value!r}",
                fix="Correct the plan.",
            )


def _kind(hint: object) -> tuple[type, bool]:
    """The type of a value of a field in TOML, and whether it is a list of these."""
    origin, args = get_origin(hint), get_args(hint)
    if origin in {tuple, UnionType}:  # such as tuple[str, ...], int | None
        return _kind(args[0])[0], origin is tuple
    if origin is Literal:
        return str, False
    return next((kind for kind in _WORDS if kind is hint), dict), False


def _scene(path: Path, folder: Path, content: Mapping[str, Any]) -> PlannedScene:
    _check(path, content, get_type_hints(PlannedScene), "scenes.")
    if not content.get("path"):
        raise SceneFormatError(
            f"a path for each of the scenes in {path}", found="none", fix="Say where it lies."
        )
    beside = {
        key: str(folder / content[key])
        for key in _FILES
        if content.get(key) and content[key] != DEMO
    }
    return PlannedScene(**{**content, **beside})


def _value(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        # JSON's escapes are TOML's, but that TOML wants one for DEL as well.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple | list):
        return f"[{', '.join(_value(each) for each in value)}]"
    return repr(value)


def _key(name: str) -> str:
    return name if name.replace("_", "").isalnum() and name.isascii() else _value(name)


def preset_plan(name: PresetName, data: Path | None) -> tuple[Plan, tuple[str, ...]]:
    """A preset's plan for the scenes that exist in a folder, and the missing ones' names.

    The presets are plans in ``data``; their scenes are those of the paper's tables 1 and 2.

    Raises:
        ParameterError: The folder is not given, or given for ``quick``, which has its own scene.
        SceneNotFoundError: None of the scenes is in it.
    """
    if name == "quick" and data is not None:
        raise ParameterError(
            "--scenes for the preset quick", found="--data", fix="Name scenes, or none."
        )
    if name != "quick" and data is None:
        raise ParameterError(
            f"--data DIR, the folder of the scenes of {name}", found="none", fix="Name it."
        )
    preset = files("splatseed.bench") / "data" / f"{name}.toml"
    plan = read_plan(Path(str(preset)), data)
    there = tuple(each for each in plan.scenes if each.is_demo or Path(each.path).is_dir())
    missing = tuple(each.label for each in plan.scenes if each not in there)
    if not there:
        raise SceneNotFoundError(
            f"scenes of {name} in {data}: {', '.join(missing)}",
            found="none of them",
            fix="Name the folder that holds them.",
        )
    return replace(plan, scenes=there), missing
