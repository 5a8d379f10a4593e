"""Versions of the code that determines a run's result: splatseed's, and that of a method.

A version is that of the package, if there is one, and a fingerprint of its files, as in
"0.3.0+9f3c21ab4c0d": code under development changes without its version. The files of a method are
those of the modules or top-level packages that define it and its base classes, and of those that
these import from outside of installed packages. Paths do not count.
"""

from __future__ import annotations

import ast
import os
import sys
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from importlib.machinery import PathFinder
from importlib.util import find_spec
from pathlib import Path

from splatseed.io.staging import MANIFEST
from splatseed.methods import BUILT_IN, METHODS, configure
from splatseed.requirements import version_of
from splatseed.runtime.fingerprint import fingerprint_all

_INSTALLED = {"site-packages", "dist-packages"}
_MAX_BYTES = 16_000_000
"""Of larger files, such as weights, only the size counts."""


@cache
def splatseed_version() -> str:
    """Return the version of splatseed."""
    return _version(version_of("splatseed"), [Path(__file__).parents[1]])


def method_version(name: str) -> str:
    """Return the version of a method of ``METHODS`` by name; empty for those of splatseed."""
    entry = METHODS.entry(name)
    if name in BUILT_IN or entry is None:
        return ""
    configured, place = configure(name), entry.value.rpartition(":")[0]
    defining = (configured, *type(configured).__mro__)
    modules = {place, *(str(getattr(each, "__module__", "")) for each in defining)}
    roots = [Path(place)] if place.endswith(".py") else []
    roots += [path for module in modules for path in _find(module, sys.path)]
    files = (entry.dist.files if entry.dist else None) or ()
    reached = _reached(roots, {Path(file.parts[0]).stem for file in files})
    return _version(entry.dist.version if entry.dist else None, reached)


def _version(number: str | None, packages: Iterable[Path]) -> str:
    ordered = sorted(packages, key=lambda path: (path.name, path))
    digest = fingerprint_all(part for path in ordered for part in _content(path))[:12]
    return f"{number}+{digest}" if number else digest


def _content(package: Path) -> Iterator[object]:
    for file in _files(package):
        yield file.relative_to(package.parent).as_posix()
        size = file.stat().st_size
        yield size if size > _MAX_BYTES else file.read_bytes()


def _files(package: Path) -> list[Path]:
    """List a module, all files of a package, or the modules in a folder without ``__init__.py``."""
    if package.is_file():
        return [package]
    regular, files = (package / "__init__.py").is_file(), list[Path]()
    for folder, below, names in os.walk(package):
        below[:] = [each for each in below if each[0] != "." and each != "__pycache__"]
        if MANIFEST in names:  # an output, such as the benchmark itself
            below.clear()
        else:
            files += [Path(folder, each) for each in names if regular or each.endswith(".py")]
    return sorted(files)


def _reached(roots: Iterable[Path], own: set[str]) -> set[Path]:
    """Follow the imports of modules and packages, but not to installed ones.

    ``own`` names those that the method's own distribution installs, which are followed.
    """
    waiting, reached = list(roots), set[Path]()
    while waiting:
        package = waiting.pop()
        if package in reached:
            continue
        reached.add(package)
        scripts = [file for file in _files(package) if file.suffix == ".py"]
        for name in {name for file in scripts for name in _imported(file)}:
            found = _find(name, [str(package.parent), *sys.path])
            waiting += [each for each in found if name in own or not _INSTALLED & set(each.parts)]
    return reached


def _imported(file: Path) -> Iterator[str]:
    """Yield the modules that a file imports anywhere, without relative imports."""
    with suppress(SyntaxError, ValueError):
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                yield node.module


def _find(module: str, paths: list[str]) -> list[Path]:
    """Find the file or the folders of a module's top-level package, unless it is part of Python."""
    name = module.partition(".")[0]
    if name in {"", "splatseed", *sys.stdlib_module_names}:
        return []
    spec = PathFinder.find_spec(name, paths)
    with suppress(ImportError, ValueError):
        spec = spec or find_spec(name)  # of an editable installation
    if spec is None:
        return []
    file = [spec.origin] if spec.has_location and spec.origin else []
    return [Path(folder).resolve() for folder in spec.submodule_search_locations or file]
