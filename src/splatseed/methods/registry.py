"""METHODS: all upsampling methods by name, and their configuration.

Built-in methods come first, then those that installed packages register under the entry-point group
``splatseed.methods`` (``name = "package.module:Class"``), which cannot replace them. Any other name
with a colon is a place: ``my_method.py:Jitter`` or ``package.module:Jitter``. A place may hold a
class, a configured method or a plain function. It is imported when it is first looked up.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from functools import cache, cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any, Literal, TypeVar, cast

from splatseed.errors import (
    MissingDependencyError,
    ParameterError,
    PluginError,
    SplatseedError,
    UnknownNameError,
)
from splatseed.methods.contract import Need, Upsampler, traits_of
from splatseed.pointcloud import GENERATED, ORIGINAL, PointCloud
from splatseed.requirements import pip_command
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Scene
from splatseed.settings import change_settings
from splatseed.text import describe_exception, did_you_mean

E = TypeVar("E", bound=SplatseedError)

GROUP = "splatseed.methods"
OWN_METHOD = (
    "A method of your own is FILE.py:NAME, or known by name once a package that registers it as an "
    f'entry point in group {GROUP} is installed (docs/methods.md, "Your own method"): '
    f"{pip_command('install', '-e', 'FOLDER')}."
)
"""Advice for an unknown name."""

BUILT_IN = {
    "linear": "splatseed.methods.elementary:Linear",
    "triangle": "splatseed.methods.elementary:Triangle",
    "spline": "splatseed.methods.surfaces:Spline",
    "mls": "splatseed.methods.surfaces:Mls",
    "voronoi": "splatseed.methods.voronoi:Voronoi",
    "depth": "splatseed.methods.depth:Depth",
    "random": "splatseed.methods.elementary:BoundingBox",
    "stereo": "splatseed.seeding.photo_methods:Stereo",
    "cover": "splatseed.seeding.photo_methods:Cover",
    "auto": "splatseed.seeding.photo_methods:Auto",
    "cloud": "splatseed.seeding.clouds.method:Cloud",
}

_CODED = "linear triangle spline mls voronoi depth random stereo cover cloud"
SOURCE_CODES = {name: code for code, name in enumerate(_CODED.split(), start=1)}
"""The ``PointCloud.source`` code of each built-in method, which files keep."""


class MethodRegistry(Mapping[str, type[Upsampler]]):
    """Methods by name; a class is imported when it is first looked up."""

    def __getitem__(self, name: str) -> type[Upsampler]:
        if name in BUILT_IN:
            module, _, attribute = BUILT_IN[name].partition(":")
            return cast("type[Upsampler]", getattr(import_module(module), attribute))
        if (entry := self.entry(name)) is not None:
            return _load(entry)
        choose = did_you_mean(str(name), self).strip() or "Choose one of these."
        raise UnknownNameError(
            f"one of the methods {', '.join(self)}", found=repr(name), fix=f"{choose} {OWN_METHOD}"
        )

    def entry(self, name: str) -> EntryPoint | None:
        """Return where a method of another package, or at a place, comes from; else None."""
        if name in self._plugins or ":" not in str(name):
            return self._plugins.get(name)
        return EntryPoint(name, name, GROUP)

    def registered(self, value: str) -> EntryPoint | None:
        """Return the entry point of another package's method at ``value``, MODULE:CLASS."""
        return next((each for each in self._plugins.values() if each.value == value), None)

    def __contains__(self, name: object) -> bool:
        return name in BUILT_IN or self.entry(str(name)) is not None

    def __repr__(self) -> str:
        return f"METHODS({', '.join(self)})"

    def __iter__(self) -> Iterator[str]:
        yield from BUILT_IN
        yield from self._plugins

    def __len__(self) -> int:
        return len(BUILT_IN) + len(self._plugins)

    @cached_property
    def _plugins(self) -> dict[str, EntryPoint]:
        return {
            entry.name: entry for entry in entry_points(group=GROUP) if entry.name not in BUILT_IN
        }


METHODS = MethodRegistry()


def _load(entry: EntryPoint) -> type[Upsampler]:
    """Import a method; one that needs no call to be configured is wrapped as if it were a class."""
    file, _, name = entry.value.rpartition(":")
    try:
        if file.endswith(".py"):
            path = Path(file).resolve()
            found = getattr(_import_file(path, path.read_bytes()), name)
        else:
            found = entry.load()
        if not callable(found):
            raise TypeError(f"{name} is {found!r}, which cannot be called")  # noqa: TRY301
    except Exception as error:  # another's code may raise anything
        raise _fault(MissingDependencyError, entry, "to be imported", error) from error
    return cast("type[Upsampler]", found if isinstance(found, type) else lambda: found)


def plugin_fault(method: Any, name: str, error: Exception) -> PluginError:
    """Return the error that names the package, or the file, of a method that raised another."""
    value = f"{getattr(method, '__module__', '')}:{type(method).__qualname__}"
    return _fault(
        PluginError,
        METHODS.registered(value) or EntryPoint(name, name, GROUP),
        "without an exception",
        error,
    )


def _fault(kind: type[E], entry: EntryPoint, task: str, error: Exception) -> E:
    expected, fix = f"method {entry.name!r}", "Correct it, or its name."
    if entry.name != entry.value:  # it is registered
        package = entry.dist.name if entry.dist else entry.value
        expected += f", {entry.value} of the package {package},"
        fix = "Correct the package and install it again, or do without: "
        fix += f"{pip_command('uninstall', package)}."
    return kind(f"{expected} {task}", found=describe_exception(error), fix=fix)


@cache
def _import_file(path: Path, content: bytes) -> ModuleType:
    """Import a file once per content; it may import what lies beside it, as a script may."""
    # Two files of one name are two modules, and none replaces an installed one.
    name = f"{path.stem}_{fingerprint(str(path), content)[:8]}"
    spec = spec_from_file_location(name, path)
    assert spec is not None  # noqa: S101  (it ends with .py)
    sys.path.insert(0, str(path.parent))
    sys.modules[name] = module = module_from_spec(spec)
    try:
        # Not cached byte code, which a change within a second of the last one leaves in place.
        exec(compile(content, path, "exec"), module.__dict__)  # noqa: S102
    except BaseException:
        del sys.modules[name]
        sys.path.remove(str(path.parent))
        raise
    return module


def absolute_place(name: str, folder: Path) -> str:
    """Return the name of a method in a file with the file's absolute path; others unchanged."""
    file, _, attribute = name.rpartition(":")
    return f"{(folder / file).resolve()}:{attribute}" if file.endswith(".py") else name


def method_label(name: str) -> str:
    """Return the name of a method without the folder of its file."""
    file, _, attribute = name.rpartition(":")
    return f"{Path(file).name}:{attribute}" if file.endswith(".py") else name


def source_code(name: str) -> int:
    """Return a method's ``PointCloud.source`` code; 255 for third-party methods."""
    return SOURCE_CODES.get(name, GENERATED)


def source_name(code: int, other: str = "other") -> str:
    """Return the method's name, or "original", for a ``PointCloud.source`` code.

    All third-party methods have one code, and the name ``other``.
    """
    names = {ORIGINAL: "original", **{code: name for name, code in SOURCE_CODES.items()}}
    return names.get(code, other)


Profile = Literal["default", "paper"]


def configure(method: str, profile: Profile = "default", **parameters: Any) -> Upsampler:
    """Make a method with its parameters.

    Args:
        method: A key of ``METHODS``, or a place.
        profile: "default" for the best parameters, "paper" for those of the paper's text.
        parameters: Fields of the method that differ from the profile's.

    Raises:
        ParameterError: No such method, profile or parameter, or a value out of range.

    Example:
        >>> configure("mls", "paper").k, configure("mls", k=12).k
        (10, 12)
    """
    kind = METHODS[method]
    if profile not in {"default", "paper"}:
        raise ParameterError(
            "the profile 'default' or 'paper'", found=repr(profile), fix="Choose one of these."
        )
    make = getattr(kind, "paper", kind) if profile == "paper" else kind
    try:
        chosen: Any = make()
    except TypeError as error:  # of another package's class
        raise ParameterError(
            f"a default for every parameter of method {method!r}",
            found=f"{error}",
            fix='Give its fields defaults (docs/methods.md, "Your own method").',
        ) from error
    except SplatseedError:
        raise
    except Exception as error:
        entry = METHODS.entry(method) or EntryPoint(method, method, GROUP)
        raise _fault(PluginError, entry, "without an exception", error) from error
    configured: Upsampler = change_settings(chosen, method, parameters)
    return configured


def resolve(
    method: str | Upsampler,
    profile: Profile = "default",
    parameters: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[str, Upsampler]:
    """Return the name of a method, and the method with its parameters."""
    if isinstance(method, str):
        return method, configure(method, profile, **parameters)
    if extra := [*parameters, *(["profile"] if profile != "default" else [])]:
        raise ParameterError(
            f"no parameters next to {method!r}, which has its own",
            found=", ".join(extra),
            fix="Give the method by name, or set its fields with dataclasses.replace.",
        )
    own = getattr(method, "__name__", type(method).__name__)  # of a function, or of a class
    return getattr(method, "name", own), method


def chooses_number(method: str | Upsampler) -> bool:
    """Whether a method chooses the number of points itself, by the photographs."""
    return traits_of(configure(method) if isinstance(method, str) else method).chooses_number


def methods_for(scene: Scene | PointCloud) -> tuple[str, ...]:
    """Return the names of methods that a scene has the points, photographs or depth maps for.

    Example:
        >>> import numpy as np
        >>> cloud = PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
        >>> "depth" in METHODS, "depth" in methods_for(cloud)
        (True, False)
    """
    there: set[Need] = {"points"}
    if isinstance(scene, Scene) and scene.depths is not None:
        there.add("depth")
    if isinstance(scene, Scene) and scene.has_photographs:
        there.add("photographs")
    return tuple(name for name in METHODS if traits_of(configure(name)).needs <= there)
