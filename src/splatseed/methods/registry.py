"""METHODS: all upsampling methods by name, and their configuration.

Built-in methods come first, then those that installed packages register under the entry-point group
``splatseed.methods`` (``name = "package.module:Class"``). A class is imported when it is first
looked up. No package can replace a built-in method.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import Any, Literal, cast

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
from splatseed.scene import Scene
from splatseed.settings import change_settings
from splatseed.text import describe_exception, did_you_mean

GROUP = "splatseed.methods"

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
        if name in self._plugins:
            return self._load(name)
        choose = did_you_mean(str(name), self).strip() or "Choose one of these."
        raise UnknownNameError(
            f"one of the methods {', '.join(self)}",
            found=repr(name),
            fix=f"{choose} A method of your own is known by name once a package that registers it "
            f"as an entry point in group {GROUP} is installed (docs/methods.md, "
            f'"Your own method"): {pip_command("install", "-e", "FOLDER")}.',
        )

    def _load(self, name: str) -> type[Upsampler]:
        entry = self._plugins[name]
        try:
            return cast("type[Upsampler]", entry.load())
        except Exception as error:  # another's code may raise anything
            raise self._fault(MissingDependencyError, name, "to be imported", error) from error

    @contextmanager
    def named(self, method: str | Upsampler) -> Iterator[None]:
        """Name the package of the method whose code runs in the block if that raises an exception.

        Raises:
            PluginError: An exception that is no error of splatseed, in a method of another package.
        """
        try:
            yield
        except (SplatseedError, MemoryError):
            raise
        except Exception as error:
            name = self._plugin_of(method)
            if name is None:
                raise
            raise self._fault(PluginError, name, "without an exception", error) from error

    def _plugin_of(self, method: str | Upsampler) -> str | None:
        if isinstance(method, str):
            return method if method in self._plugins else None
        for name, entry in self._plugins.items():
            with suppress(Exception):  # one that cannot be imported is not this one
                if isinstance(method, entry.load()):
                    return name
        return None

    def _fault(
        self, kind: type[SplatseedError], name: str, expected: str, error: Exception
    ) -> SplatseedError:
        entry = self._plugins[name]
        package = entry.dist.name if entry.dist else entry.value
        return kind(
            f"method {name!r}, {entry.value} of the package {package}, {expected}",
            found=describe_exception(error),
            fix="Correct the package and install it again, or do without: "
            f"{pip_command('uninstall', package)}.",
        )

    def __contains__(self, name: object) -> bool:
        return name in BUILT_IN or name in self._plugins

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
        method: A key of ``METHODS``.
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
    with METHODS.named(method):
        chosen: Any = getattr(kind, "paper", kind)() if profile == "paper" else kind()
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
    return getattr(method, "name", type(method).__name__), method


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
