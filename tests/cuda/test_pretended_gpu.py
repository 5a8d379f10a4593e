"""The CUDA path without a GPU: ``pretended/README.md`` says how, ``gpu_cases.py`` what is held."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("gsplat", reason="training needs gsplat")

import torch

HERE = Path(__file__).parent / "pretended"
ROOT = Path(__file__).parents[2]


SOURCES = HERE / "guard.cpp", HERE / "hooks.cpp"


@pytest.fixture(scope="module")
def guard(request):
    """The device guard, built against this PyTorch: once, as that takes the compiler 15 seconds."""
    if shutil.which("g++") is None:
        pytest.skip("needs g++ to build a device guard for PyTorch")
    if torch.version.cuda is not None:
        pytest.skip("this PyTorch is a CUDA build: benchmarks/gpu tries the real thing")
    if not sys.platform.startswith("linux"):
        pytest.skip("PyTorch's libraries have other names here")
    home = Path(torch.__file__).parent
    content = b"".join(path.read_bytes() for path in SOURCES)
    folder = request.config.cache.mkdir("device_guard")
    built = folder / f"{torch.__version__}-{hashlib.sha256(content).hexdigest()[:16]}.so"
    if built.exists():
        return built
    partial = folder / f"{os.getpid()}.so"
    command = [
        "g++", "-std=c++20", "-O1", "-fPIC", "-shared",
        f"-I{home / 'include'}", f"-I{home / 'include/torch/csrc/api/include'}",
        *map(str, SOURCES), f"-L{home / 'lib'}", "-lc10", "-ltorch_cpu", "-o", str(partial),
    ]  # fmt: skip
    subprocess.run(command, check=True)
    return partial.rename(built)


@pytest.mark.slow
def test_training_on_a_pretended_gpu(guard, tmp_path):
    command = [
        sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--durations=5",
        f"--rootdir={ROOT}", "-c", str(ROOT / "pyproject.toml"), f"--basetemp={tmp_path / 'base'}",
        str(HERE / "gpu_cases.py"),
    ]  # fmt: skip
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST")}
    environment["PRETENDED_GUARD"] = str(guard)
    ran = subprocess.run(
        command, env=environment, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout[-6000:] + ran.stderr[-2000:]
    assert " passed" in ran.stdout
