"""The benchmarks as modules: scripts of the checkout, which import each other."""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def bench(request):
    """A test file's ``MODULES``, such as "rendering.render", by the last part of their names."""
    sys.path.insert(0, str(ROOT))
    yield SimpleNamespace(
        **{
            name.rpartition(".")[2]: import_module(f"benchmarks.{name}")
            for name in request.module.MODULES
        }
    )
    sys.path.remove(str(ROOT))
