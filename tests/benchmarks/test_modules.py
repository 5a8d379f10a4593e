"""Every benchmark can be loaded: most are too long to be run by a test."""

from __future__ import annotations

from importlib import import_module

import pytest

from splatseed.errors import ParameterError

from .conftest import ROOT

FILES = [path.relative_to(ROOT) for path in sorted((ROOT / "benchmarks").rglob("*.py"))]
MODULES = [".".join(path.with_suffix("").parts) for path in FILES if path.stem != "__init__"]


@pytest.fixture(autouse=True)
def in_the_checkout(monkeypatch):
    monkeypatch.syspath_prepend(ROOT)


def test_every_benchmark_finds_what_it_imports():
    pytest.importorskip("gsplat", reason="some need PyTorch and gsplat's strategies")
    assert len(MODULES) > 20
    for name in MODULES:
        import_module(name)


def test_without_a_gpu_its_benchmark_is_one_sentence():
    torch = pytest.importorskip("torch", reason="it asks PyTorch for a GPU")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    gpu = import_module("benchmarks.gpu.__main__")
    with pytest.raises(ParameterError, match="expected a GPU; found none that PyTorch sees"):
        gpu.main(gpu.Options())
