"""Plans as TOML files, and ready-made ones: the paper's data sets, and two that a laptop can run.

Promise: ``read_plan`` reads what ``plan_text`` writes back as the same plan; a misspelt key, or a
value of the wrong kind, is an error and never ignored. Paths in a file are relative to it. A
preset's scenes are folders of one folder, the data set; scenes, folders of photographs, ratios and
steps of the paper's presets are those of its tables 1 and 2 (docs/paper.md); photographs are taken
as the data set provides them, not downsampled anew.
"""

from __future__ import annotations

import dataclasses
import json
import tomllib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from splatseed.bench.plan import DEMO, SFM, SHARED, Plan, PlannedScene
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


class _Kind(NamedTuple):
    """The kind of value that a key takes: one of these types, or a list of them."""

    words: str
    types: tuple[type, ...]
    listed: bool = False

    def fits(self, value: object) -> bool:
        """Whether a value is of this kind; true and false are no numbers."""
        if isinstance(value, list) != self.listed:
            return False
        each = value if isinstance(value, list) else [value]
        return all(type(one) in self.types for one in each)


_TEXT = _Kind("text", (str,))
_TEXTS = _Kind("a list of texts", (str,), listed=True)
_WHOLE = _Kind("a whole number", (int,))
_TRUTH = _Kind("true or false", (bool,))
_TABLE = _Kind("a table", (dict,))


def _kind_of(default: object) -> _Kind:
    """The kind of a training setting; one without a default is a whole number."""
    kinds = {bool: _TRUTH, str: _TEXT, float: _Kind("a number", (int, float))}
    return kinds.get(type(default), _WHOLE)


KINDS: Mapping[str, _Kind] = {
    "methods": _TEXTS,
    "ratios": _Kind("a list of numbers", (int, float), listed=True),
    "budgets": _Kind('a list of budgets such as "0.25rho"', (str, int, float), listed=True),
    "strategies": _TEXTS,
    "profiles": _TEXTS,
    "repeats": _WHOLE,
    **{name: _kind_of(getattr(TrainSettings, name)) for name in SHARED},
    "long_side": _WHOLE,
    "keep_models": _TRUTH,
    "lpips": _TRUTH,
    "scenes": _Kind("tables, each headed [[scenes]]", (dict,), listed=True),
    "parameters": _TABLE,
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
    for method, parameters in content.get("parameters", {}).items():
        name = f"parameters.{method}"
        _check(path, name, parameters, {name: _TABLE})
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in content.items()
    }
    values["scenes"] = tuple(_scene(path, each) for each in content.get("scenes", ()))
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
        values = dataclasses.asdict(scene)
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
    kinds = {f"scenes.{each.name}": _TEXT for each in dataclasses.fields(PlannedScene)}
    for key, value in content.items():
        _check(path, f"scenes.{key}", value, kinds)
    if not content.get("path"):
        raise SceneFormatError(
            f"a path for each of the scenes in {path}", found="none", fix="Say where it lies."
        )
    beside = {
        key: str(path.parent / content[key])
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


_PAPER = (SFM, "linear", "triangle", "spline", "mls", "voronoi")
_OUTDOOR = ("bicycle", "flowers", "garden", "stump", "treehill")
_INDOOR = ("bonsai", "counter", "kitchen", "room")
_REPLICA = (*(f"office{i}" for i in range(5)), *(f"room{i}" for i in range(3)))


def preset_plan(name: PresetName, data: Path | None) -> tuple[Plan, tuple[str, ...]]:
    """A preset's plan for the scenes that exist.

    Args:
        name: The preset.
        data: The folder of the data set's scenes; not for ``quick``, which has the synthetic room.

    Returns:
        The plan, and the names of missing scenes.

    Raises:
        ParameterError: The folder is not given, or given for ``quick``.
        SceneNotFoundError: None of the scenes is in it.
    """
    if name == "quick":
        if data is not None:
            raise ParameterError(
                "--scenes for the preset quick", found="--data", fix="Name scenes, or none."
            )
        training = TrainSettings(max_steps=500, data_factor=2)
        scenes = (PlannedScene(DEMO),)
        return Plan(scenes, strategies=("none", "default"), repeats=2, training=training), ()
    if data is None:
        raise ParameterError(
            f"--data DIR, the folder of the scenes of {name}", found="none", fix="Name it."
        )
    plan = {"mipnerf360": _mipnerf360, "replica": _replica, "laptop": _laptop}[name](data)
    there = tuple(scene for scene in plan.scenes if Path(scene.path).is_dir())
    missing = tuple(scene.label for scene in plan.scenes if scene not in there)
    if not there:
        raise SceneNotFoundError(
            f"scenes of {name} in {data}: {', '.join(missing)}",
            found="none of them",
            fix="Name the folder that holds them.",
        )
    return replace(plan, scenes=there), missing


def _mipnerf360(data: Path) -> Plan:
    folders = {**dict.fromkeys(_OUTDOOR, "images_4"), **dict.fromkeys(_INDOOR, "images_2")}
    scenes = tuple(
        PlannedScene(str(data / name), name, images=folders[name]) for name in sorted(folders)
    )
    return Plan(scenes, methods=_PAPER, ratios=(4, 8, 16))


def _replica(data: Path) -> Plan:
    scenes = tuple(PlannedScene(str(data / name), name) for name in _REPLICA)
    return Plan(scenes, methods=(*_PAPER, "depth"), ratios=(16, 32))


def _laptop(data: Path) -> Plan:
    """All arms at one number of Gaussians."""
    return Plan(
        scenes=tuple(
            PlannedScene(str(data / name), name) for name in ("fern", "fox", "bonsai", "treehill")
        ),
        methods=(SFM, "mls", "auto"),
        ratios=(),
        budgets=("0.25rho",),
        strategies=("default", "grow"),
        repeats=2,
        training=TrainSettings(max_steps=1500),
        long_side=400,
    )
