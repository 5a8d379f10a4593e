"""The same bytes, forward and backward, whatever the threads and wherever the kernels come from.

Run as a module: other processes, with other numbers of threads or caches, must print the same.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import torch

from .scenes import gradients, random_scene

MODES = (
    {},
    {"rasterize_mode": "antialiased", "packed": False},
    {"render_mode": "RGB+ED", "sh_degree": 3},
)


def digest(modes: Sequence[Mapping[str, Any]] = MODES) -> str:
    """SHA-256 of images, alphas and all gradients of a crowd in two cameras."""
    total = hashlib.sha256()
    for options in modes:
        rng, coefficients = np.random.default_rng(0), 16 if "sh_degree" in options else None
        scene = random_scene(rng, 3000, cameras=2, size=(77, 59), coefficients=coefficients)
        image, alpha, grads = gradients(scene, **options)
        for each in (image, alpha, *grads.values()):
            total.update(each.numpy().tobytes())
    return total.hexdigest()


@pytest.fixture(scope="module")
def expected() -> str:
    return digest()


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="this machine has one thread")
@pytest.mark.parametrize("threads", [1, 2])
def test_any_number_of_threads(expected: str, threads: int) -> None:
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        assert digest() == expected
    finally:
        numba.set_num_threads(before)


def test_freshly_compiled_and_loaded_from_the_cache(tmp_path: Path) -> None:
    """A new process with an empty cache compiles; a second one loads what the first has left."""
    expected = digest(MODES[:1])  # compiling for the others takes most of a minute
    assert _in_new_process(tmp_path) == expected
    compiled = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
    assert compiled
    assert _in_new_process(tmp_path) == expected
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")} == compiled


def _in_new_process(cache: Path) -> str:
    run = subprocess.run(
        [sys.executable, "-m", "tests.render.test_determinism"], cwd=Path(__file__).parents[2],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache)}, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return run.stdout.strip()


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(digest(MODES[:1]))  # noqa: T201  (its one result)
