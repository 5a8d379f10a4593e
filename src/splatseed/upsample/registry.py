"""METHODS: every upsampling method by name, imported when first looked up.

Built-in methods come first: those in ``methods/``, and those that higher parts of the package add
when they are imported along with it (``add_built_in``). Then come those that installed packages
register under the entry-point group ``splatseed.methods`` (``name = "package.module:Class"``). A
built-in name cannot be overridden.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from typing import cast

from splatseed.errors import ParameterError
from splatseed.pointcloud import GENERATED, ORIGINAL
from splatseed.upsample.method import Upsampler

GROUP = "splatseed.methods"

BUILT_IN = {
    "linear": "splatseed.upsample.methods.linear:Linear",
    "triangle": "splatseed.upsample.methods.triangle:Triangle",
    "spline": "splatseed.upsample.methods.spline:Spline",
    "mls": "splatseed.upsample.methods.mls:Mls",
    "voronoi": "splatseed.upsample.methods.voronoi:Voronoi",
    "depth": "splatseed.upsample.methods.depth:Depth",
    "random": "splatseed.upsample.methods.bounding_box:BoundingBox",
}

SOURCE_CODES = {
    "linear": 1,
    "triangle": 2,
    "spline": 3,
    "mls": 4,
    "voronoi": 5,
    "depth": 6,
    "random": 7,
    "stereo": 8,
    "cover": 9,
    "cloud": 10,
}
"""The ``PointCloud.source`` code of each built-in method."""


class MethodRegistry(Mapping[str, type[Upsampler]]):
    """The methods by name; a class is imported when it is first looked up."""

    def __getitem__(self, name: str) -> type[Upsampler]:
        if name in BUILT_IN:
            module, _, attribute = BUILT_IN[name].partition(":")
            return cast("type[Upsampler]", getattr(import_module(module), attribute))
        if name in self._plugins:
            return cast("type[Upsampler]", self._plugins[name].load())
        raise ParameterError(
            f"one of the methods {', '.join(self)}", found=repr(name), fix="Choose one of these."
        )

    def __contains__(self, name: object) -> bool:
        return name in BUILT_IN or name in self._plugins

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


def add_built_in(methods: Mapping[str, str]) -> None:
    """Let a part of the package that imports this one add methods of its own.

    Args:
        methods: "module:Class" by name; none is imported before it is looked up.
    """
    BUILT_IN.update(methods)


def source_code(name: str) -> int:
    """The ``PointCloud.source`` code of a method; 255 for every third-party method."""
    return SOURCE_CODES.get(name, GENERATED)


def origin_name(code: int) -> str:
    """The name of a ``PointCloud.source`` code."""
    names = {ORIGINAL: "original", **{code: name for name, code in SOURCE_CODES.items()}}
    return names.get(code, "other")
