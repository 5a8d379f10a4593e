"""Building gsplat's kernels: once, found tools, and one sentence where it fails.

A stand-in for gsplat builds as the real one does: it removes what lies there, and takes its time.
"""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")

BACKEND = """
import os, pathlib, shutil, time
root = pathlib.Path(os.environ["TORCH_EXTENSIONS_DIR"]) / "gsplat_cuda"
print("gsplat: No output of ours")
if {fails}:
    raise RuntimeError("Error building extension 'gsplat_cuda': nvcc fatal : no such thing")
if not (root / "gsplat_cuda.so").exists():
    shutil.rmtree(root, ignore_errors=True)
    root.mkdir(parents=True)
    time.sleep(0.5)
    (root / f"built-by-{{os.getpid()}}").touch()
    (root / "gsplat_cuda.so").touch()
_C = object() if shutil.which("ninja") else None
"""
NO_HOME = "CUDA_HOME = None"
"""What builds extensions in PyTorch, as it is where there is no CUDA toolkit."""
LOAD = """
import sys
from splatseed.errors import MissingDependencyError
from splatseed.runtime.torch_device import load_kernels
stages = []
try:
    load_kernels("backend", lambda stage, _: stages.append(stage))
    load_kernels("backend")  # the second time there is nothing to do
except MissingDependencyError as error:
    print(error)
print(*stages)
"""


@pytest.fixture
def machine(tmp_path):
    """The environment of a machine with nvcc and a compiler, but ninja only beside Python."""
    tools = tmp_path / "tools"
    tools.mkdir()
    for name, said in {"nvcc": "Cuda compilation tools, release 12.8, V12.8.93", "c++": ""}.items():
        (tools / name).write_text(f"#!/bin/sh\necho '{said}'\n")
        (tools / name).chmod(0o755)
    return {
        **{k: v for k, v in os.environ.items() if k not in {"CUDA_HOME", "CUDA_PATH", "CXX"}},
        "PATH": str(tools),
        "PYTHONPATH": str(tmp_path / "peer"),
        "TORCH_EXTENSIONS_DIR": str(tmp_path / "built"),
    }


def _stand_in(folder, *, fails=False, torch=False):
    """Of gsplat, and where asked of PyTorch, which takes each process four seconds to import."""
    if torch:
        (folder / "peer/torch/utils").mkdir(parents=True)
        for name, text in {
            "__init__": "",
            "utils/__init__": "",
            "utils/cpp_extension": NO_HOME,
        }.items():
            (folder / f"peer/torch/{name}.py").write_text(text)
    (folder / "peer/gsplat/cuda").mkdir(parents=True)
    (folder / "peer/gsplat/__init__.py").touch()
    (folder / "peer/gsplat/cuda/_backend.py").write_text(BACKEND.format(fails=fails))


def _start(environment):
    command = [sys.executable, "-c", LOAD]
    return subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def test_processes_that_come_at_once_build_once(machine, tmp_path):
    _stand_in(tmp_path, torch=True)
    ended = [each.communicate() for each in [_start(machine) for _ in range(2)]]
    assert not any(err for _, err in ended), ended
    assert len(list((tmp_path / "built/gsplat_cuda").glob("built-by-*"))) == 1
    said = [out.strip() for out, _ in ended]
    assert sorted(said) == ["", "building gsplat's kernels, some minutes, once"]


def test_a_build_that_fails_is_one_sentence(machine, tmp_path):
    _stand_in(tmp_path, fails=True)
    out, err = _start(machine).communicate()
    assert not err
    assert "nvcc fatal : no such thing" in out
    assert "`backend='cpu'`" in out
