"""Height-field patches: the data that surface-fitting methods share, and the map back to 3D.

Around a base point p with k neighbours stands a frame (e_u, e_v, e_n), the rows of ``frames[i]``.
A surface is a height z = S(u, v) over the plane through p, and the new point at (u, v) is
p + u e_u + v e_v + z e_n. u, v and z are in scene units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64

from splatseed.kernels.jit import inline, kernel, parallel_range
from splatseed.upsample.neighbors import Bases, Neighbors, PreparedCloud
from splatseed.upsample.surfaces.frames import coordinate

__all__ = ["Patches", "lift"]


@dataclass(frozen=True, eq=False)
class Patches:
    """One patch per row, and the places on it where new points go.

    Args:
        cloud: The prepared originals, n rows.
        neighbors: The k neighbours of each row.
        bases: The new points of each row, M in all.
        frames: Axes of each patch as rows e_u, e_v, e_n, float64 [n, 3, 3].
        collinear: Rows with a collinear neighbourhood, bool [n].
        uv: Position of each new point on its patch, float32 [M, 2], scene units.
    """

    cloud: PreparedCloud
    neighbors: Neighbors
    bases: Bases
    frames: Float64[np.ndarray, "n 3 3"]
    collinear: Bool[np.ndarray, " n"]
    uv: Float32[np.ndarray, "M 2"]


def lift(
    patches: Patches, height: Float32[np.ndarray, " M"], clamp: float | None
) -> Float32[np.ndarray, "M 3"]:
    """World positions of the new points, float32 [M, 3].

    Args:
        patches: The patches.
        height: S(u, v) of every new point, float32 [M].
        clamp: Heights are clamped to the neighbours' range, widened on both sides by this fraction
            of it; None leaves them unchanged.
    """
    cloud, bases = patches.cloud, patches.bases
    out = np.empty((bases.total, 3), np.float32)
    margin = np.inf if clamp is None else float(clamp)
    _lift(
        cloud.xyz, cloud.center, patches.neighbors.idx, patches.frames,
        bases.start, bases.count, patches.uv, height, margin, out,
    )  # fmt: skip
    return out


@kernel
def _lift(xyz, center, idx, frames, start, count, uv, height, margin, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Compute p + u e_u + v e_v + clamp(z) e_n for all new points of all rows."""
    for i in parallel_range(len(count)):
        if count[i] > 0:
            e_u, e_v, e_n = frames[i, 0], frames[i, 1], frames[i, 2]
            low, high = _height_range(xyz, i, idx[i], e_n)
            slack = margin * (high - low) if margin < np.inf else np.inf
            for m in range(start[i], start[i] + count[i]):
                u, v = np.float64(uv[m, 0]), np.float64(uv[m, 1])
                z = min(max(np.float64(height[m]), low - slack), high + slack)
                for axis in range(3):
                    local = u * e_u[axis] + v * e_v[axis] + z * e_n[axis]
                    out[m, axis] = center[axis] + (xyz[i, axis] + local)


@inline
def _height_range(xyz, i, rows, e_n):  # type: ignore[no-untyped-def]  # Numba's types
    """Lowest and highest of the neighbours and the base (at 0) along the normal."""
    low = high = 0.0
    for j in rows:
        z = coordinate(xyz, i, j, e_n)
        low = min(low, z)
        high = max(high, z)
    return low, high
