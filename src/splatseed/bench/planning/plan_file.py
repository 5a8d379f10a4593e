"""Plans as TOML files: reading with errors that name the key, and writing in readable form.

Promise: ``read_plan`` reads what ``plan_text`` writes back as the same plan; a misspelt key, or a
value of the wrong kind, is an error and never ignored. Paths in a file are relative to it.
"""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from splatseed.bench.planning.plan import DEMO, Plan, PlannedScene
from splatseed.bench.planning.records import SHARED
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import read_text
from splatseed.literal import quoted
from splatseed.train.settings import TrainSettings

SCENES = "scenes"
PARAMETERS = "parameters"
FILES = ("path", "depth", "cloud")
"""Keys of a scene that are paths, relative to the plan's file."""
SCENE_KEYS = tuple(each.name for each in dataclasses.fields(PlannedScene))


class _Kind(NamedTuple):
    """A kind of value that a key takes."""

    words: str
    fits: Callable[[Any], bool]


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _all(kind: type | Callable[[Any], bool]) -> Callable[[Any], bool]:
    def fits(value: object) -> bool:
        if not isinstance(value, list):
            return False
        return all(isinstance(x, kind) if isinstance(kind, type) else kind(x) for x in value)

    return fits


TEXT = _Kind("text", lambda value: isinstance(value, str))
TEXTS = _Kind("a list of texts", _all(str))
NUMBERS = _Kind("a list of numbers", _all(_is_number))
BUDGETS = _Kind(
    'a list of budgets such as 20000, "20k" or "0.25rho"',
    _all(lambda value: isinstance(value, str) or _is_number(value)),
)
WHOLE = _Kind("a whole number", lambda value: type(value) is int)
NUMBER = _Kind("a number", _is_number)
TRUTH = _Kind("true or false", lambda value: isinstance(value, bool))
TABLE = _Kind("a table", lambda value: isinstance(value, dict))
TABLES = _Kind("tables, each headed [[scenes]]", _all(dict))


def _kind_of(default: object) -> _Kind:
    """The kind of a training setting; the one without a default is a whole number."""
    kinds = {bool: TRUTH, str: TEXT, float: NUMBER}
    return kinds.get(type(default), WHOLE)


KINDS: Mapping[str, _Kind] = {
    "methods": TEXTS,
    "ratios": NUMBERS,
    "budgets": BUDGETS,
    "strategies": TEXTS,
    "profiles": TEXTS,
    "repeats": WHOLE,
    **{name: _kind_of(getattr(TrainSettings, name)) for name in SHARED},
    "long_side": WHOLE,
    "keep_models": TRUTH,
    "lpips": TRUTH,
    SCENES: TABLES,
    PARAMETERS: TABLE,
}
"""What each key of a plan takes: one per field of ``Plan``, except that ``training`` is flat."""


def read_plan(path: Path) -> Plan:
    """Read a plan.

    Args:
        path: The TOML file.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no TOML, or a key or a value is not one of a plan.
    """
    content = _read_toml(path)
    for key, value in content.items():
        _check(path, key, value, KINDS)
    values: dict[str, Any] = {
        key: tuple(v) if isinstance(v, list) else v for key, v in content.items()
    }
    if SCENES in content:
        values[SCENES] = tuple(_scene(path, each) for each in content[SCENES])
    for method, parameters in content.get(PARAMETERS, {}).items():
        _check(path, f"{PARAMETERS}.{method}", parameters, {f"{PARAMETERS}.{method}": TABLE})
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
        if key not in {SCENES, PARAMETERS} and value is not None:
            lines.append(f"{key} = {_value(value)}")
    for scene in plan.scenes:
        lines += ["", f"[[{SCENES}]]", *_scene_lines(scene)]
    for method, parameters in plan.parameters.items():
        lines += ["", f"[{PARAMETERS}.{_key(method)}]"]
        lines += [f"{_key(name)} = {_value(value)}" for name, value in parameters.items()]
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
    except OSError as error:
        found = error.strerror or type(error).__name__
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        found = str(error)
    raise SceneFormatError(
        f"{path} to be a plan in TOML", found=found, fix="splatseed bench --dry-run prints one."
    )


def _check(path: Path, key: str, value: object, kinds: Mapping[str, _Kind]) -> None:
    if key not in kinds:
        raise SceneFormatError(
            f"a key of a plan in {path} ({', '.join(kinds)})",
            found=repr(key),
            fix="Check its spelling.",
        )
    if not kinds[key].fits(value):
        raise SceneFormatError(
            f"{key} in {path} to be {kinds[key].words}", found=f"{value!r}", fix="Correct the plan."
        )


def _scene(path: Path, content: Mapping[str, Any]) -> PlannedScene:
    kinds = {f"{SCENES}.{key}": TEXT for key in SCENE_KEYS}
    for key, value in content.items():
        _check(path, f"{SCENES}.{key}", value, kinds)
    if not content.get("path"):
        raise SceneFormatError(
            f"a path for each of the {SCENES} in {path}", found="none", fix="Say where it lies."
        )
    beside = {
        key: str(path.parent / content[key])
        for key in FILES
        if content.get(key) and content[key] != DEMO
    }
    return PlannedScene(**{**content, **beside})


def _scene_lines(scene: PlannedScene) -> list[str]:
    values = dataclasses.asdict(scene)
    for key in FILES:
        if values[key] and values[key] != DEMO:
            values[key] = str(Path(values[key]).absolute())
    return [f"{key} = {_value(value)}" for key, value in values.items() if value]


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
