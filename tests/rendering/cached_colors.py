"""Colours by harmonics and their gradients: vector code of four files, compiled in seconds.

Run as a module: prints what their bytes are in another process, with its own cache of kernels.
"""

from __future__ import annotations

import hashlib
import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType

import numpy as np

import splatseed

PACKAGE = "splatseed.rendering"


def digest_of_colors() -> str:
    """SHA-256 of the colours of a crowd and of the gradients of their positions and rows."""
    kernels = import_module(f"{PACKAGE}._kernels.harmonics")
    table = import_module(f"{PACKAGE}.harmonics").TABLES[3]
    rng, shapes = np.random.default_rng(0), ((3000, 3), (3,), (3000, 16, 3))
    means, origin, base = (rng.normal(size=shape).astype(np.float32) for shape in shapes)
    inputs = means, origin, base, base.reshape(-1), 3, np.ones((3000, 2), np.int32), table
    colors, d_means, d_base = (np.empty_like(each) for each in (means, means, base))
    kernels.harmonics(*inputs, colors)
    d_rows = d_base.reshape(-1)
    kernels.harmonics_vjp(means, origin, *inputs[3:], colors, 2 * colors, d_means, d_base, d_rows)
    results = colors, d_means, d_base
    assert all(np.abs(each).max() > 0.1 for each in results)
    return hashlib.sha256(b"".join(each.tobytes() for each in results)).hexdigest()


if __name__ == "__main__":
    # Without the package's own front door, which takes each process the seconds to import PyTorch.
    package = ModuleType(PACKAGE)
    package.__path__ = [str(Path(splatseed.__file__).parent / "rendering")]
    sys.modules[PACKAGE] = package
    print(digest_of_colors())  # noqa: T201  (its one result)
    assert "torch" not in sys.modules
