"""The same bytes, forward and backward, for any number of threads, compiled or from a cache."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest

from .cached_colors import digest_of_colors
from .scenes import gradients, random_scene

MODES = ({}, {"rasterize_mode": "antialiased", "packed": False},
         {"render_mode": "RGB+ED", "sh_degree": 3})  # fmt: skip


def digest(tensors):
    """SHA-256 of their bytes."""
    return hashlib.sha256(b"".join(each.detach().numpy().tobytes() for each in tensors)).hexdigest()


def renders():
    """Images, alphas and all gradients of a crowd in two cameras."""
    results = []
    for options in MODES:
        rng, coefficients = np.random.default_rng(0), 16 if "sh_degree" in options else None
        scene = random_scene(rng, 3000, cameras=2, size=(77, 59), coefficients=coefficients)
        image, alpha, grads = gradients(scene, **options)
        results += [image, alpha, *grads.values()]
    return results


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="this machine has one thread")
def test_any_number_of_threads():
    before, digests = numba.get_num_threads(), set()
    try:
        for threads in (before, 1, 2):
            numba.set_num_threads(threads)
            digests.add(digest(renders()))
    finally:
        numba.set_num_threads(before)
    assert len(digests) == 1


def test_freshly_compiled_and_loaded_from_the_cache(tmp_path):
    """A new process with an empty cache compiles; a second one loads what the first has left."""
    expected = digest_of_colors()
    assert _in_new_process(tmp_path) == expected
    compiled = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
    assert compiled
    assert _in_new_process(tmp_path) == expected
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")} == compiled


def _in_new_process(cache):
    run = subprocess.run(
        [sys.executable, "-m", "tests.rendering.cached_colors"], cwd=Path(__file__).parents[2],
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache)}, capture_output=True, text=True,
        check=True,
    )  # fmt: skip
    return run.stdout.strip()
