"""Cached machine code belongs to the present sources, in every file that a kernel reaches."""

from __future__ import annotations

import importlib
import os
import sys

import numba
import pytest

from splatseed.runtime import kernel_cache

FILES = {
    "__init__": "",
    "kernels": """
from splatseed.runtime.jit import inline

from tiny.middle import (
    halved,
    shifted,
)

@inline
def twice_shifted(x):
    return shifted(2.0 * x) + halved(0.0)
""",
    "middle": """
from splatseed.runtime.jit import inline
from . import numbers
from .numbers import SHIFT

@inline
def shifted(x):
    return x + SHIFT

@inline
def halved(x):
    return numbers.HALF * x
""",
    "numbers": "SHIFT, HALF = 1.0, 0.5\n",
    "aside": "UNUSED = 1.0\n",
}


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """A package with a kernel that calls functions of a second file, which use constants of a
    third."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    yield folder
    forget()


def forget():
    """Forget the package, as a new process does."""
    for name in [name for name in sys.modules if name.partition(".")[0] in {"tiny", "small"}]:
        del sys.modules[name]
    importlib.invalidate_caches()
    for cached in (
        kernel_cache.cache_folder, kernel_cache._digest, kernel_cache._imported_names
    ):  # fmt: skip
        cached.cache_clear()


def first_call(package="tiny"):
    """The kernel's result, and whether its code came from the cache."""
    forget()
    function = importlib.import_module(f"{package}.kernels").twice_shifted
    return function(3.0), bool(function.stats.cache_hits)


def test_a_kernel_is_compiled_again_when_a_file_that_it_reaches_changes(tiny):
    assert first_call() == (7.0, False)
    (tiny / "aside.py").write_text("UNUSED = 2.0\n")
    assert first_call() == (7.0, True)
    (tiny / "numbers.py").write_text("SHIFT, HALF = 2.25, 0.5\n")
    assert first_call() == (8.25, False)
    (tiny / "numbers.py").write_text("SHIFT, HALF = 1.0, 0.5\n")
    assert first_call() == (7.0, True)


def test_a_renamed_package_loads_no_code_of_its_old_name(tiny):
    assert first_call() == (7.0, False)
    small = tiny.rename(tiny.parent / "small")
    (small / "kernels.py").write_text(FILES["kernels"].replace("tiny", "small"))
    assert first_call("small") == (7.0, False)


@pytest.mark.parametrize("used", ["long ago", "lately"])
def test_folders_of_earlier_sources_are_removed(tiny, used):
    first_call()
    cache = tiny.parent / "cache"
    (old,) = cache.glob("tiny.kernels-*")
    if used == "long ago":
        os.utime(old, (0, 0))
    (tiny / "numbers.py").write_text("SHIFT, HALF = 2.25, 0.5\n")
    first_call()
    assert old.exists() == (used == "lately")
    assert len(list(cache.glob("tiny.kernels-*"))) == 1 + old.exists()


def test_a_kernel_runs_where_no_cache_can_be_written(tiny, monkeypatch):
    (tiny.parent / "file").touch()
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tiny.parent / "file"))
    assert first_call() == (7.0, False)
    assert not list(tiny.rglob("*.nbi"))


def test_a_kernel_reaches_what_compiles_it_and_the_lanes_that_it_uses():
    importlib.import_module("splatseed.rendering._kernels.harmonics")
    reached = kernel_cache.reached_files("splatseed.rendering._kernels.harmonics").keys()
    assert "splatseed.cli" not in reached
    for name in ("progress", "runtime.jit", "runtime.workarounds", "runtime.simd"):
        assert f"splatseed.{name}" in reached
