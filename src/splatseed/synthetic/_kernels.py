"""Numba kernels: textures (value noise), leaves (nearest disc, first disc along a ray), waves."""

import numpy as np

from splatseed.runtime.jit import inline


@inline
def _lattice(x: int, y: int, z: int, seed: int) -> float:
    """Hash a lattice point to 0..1 (multiply-xorshift rounds on 64 bits)."""
    h = np.uint64(x) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(seed)
    h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(y)
    h = (h ^ (h >> np.uint64(32))) * np.uint64(0x94D049BB133111EB) + np.uint64(z)
    h = (h ^ (h >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)
    return float((h ^ (h >> np.uint64(32))) >> np.uint64(11)) * 2.0**-53


@inline
def _octave(x: float, y: float, z: float, seed: int) -> float:
    """Return one octave of value noise: a smoothed trilinear blend of 8 lattice values."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    ix, iy, iz = int(fx), int(fy), int(fz)
    u, v, w = x - fx, y - fy, z - fz
    u, v, w = u * u * (3 - 2 * u), v * v * (3 - 2 * v), w * w * (3 - 2 * w)
    total = 0.0
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
        weight = (u if i else 1 - u) * (v if j else 1 - v) * (w if k else 1 - w)
        if weight > 0.0:
            total += weight * _lattice(ix + i, iy + j, iz + k, seed)
    return total


@inline
def noise_sum(
    xyz: np.ndarray,  # float64 [N, 3]
    octaves: int,
    seed: int,
) -> np.ndarray:  # float64 [N]
    """Return the weighted mean of octaves at each point."""
    result = np.zeros(len(xyz))
    for i in range(len(xyz)):
        scale, strength, total = 1.0, 1.0, 0.0
        for octave in range(octaves):
            value = _octave(xyz[i, 0] * scale, xyz[i, 1] * scale, xyz[i, 2] * scale, seed + octave)
            result[i] += strength * value
            total += strength
            scale *= 2.0
            strength *= 0.7
        result[i] /= total
    return result


@inline
def nearest_disc(
    xyz: np.ndarray,  # float64 [N, 3]
    centers: np.ndarray,  # float64 [L, 3]
    axes: np.ndarray,  # float64 [L, 3]
    radii: np.ndarray,  # float64 [L]
) -> tuple[np.ndarray, np.ndarray]:  # float64 [N], int64 [N]
    """Return the distance to the nearest disc, and its index."""
    distances = np.empty(len(xyz))
    which = np.empty(len(xyz), np.int64)
    for i in range(len(xyz)):
        best, best_j = np.inf, 0
        for j in range(len(radii)):
            x = xyz[i, 0] - centers[j, 0]
            y = xyz[i, 1] - centers[j, 1]
            z = xyz[i, 2] - centers[j, 2]
            off = x * axes[j, 0] + y * axes[j, 1] + z * axes[j, 2]
            x, y, z = x - off * axes[j, 0], y - off * axes[j, 1], z - off * axes[j, 2]
            # Distance beyond the rim, in the disc's plane.
            beyond = max(np.sqrt(x * x + y * y + z * z) - radii[j], 0.0)
            squared = off * off + beyond * beyond
            if squared < best:
                best, best_j = squared, j
        distances[i] = np.sqrt(best)
        which[i] = best_j
    return distances, which


@inline
def first_disc(
    origin: np.ndarray,  # float64 [3]
    directions: np.ndarray,  # float64 [N, 3]
    centers: np.ndarray,  # float64 [L, 3]
    axes: np.ndarray,  # float64 [L, 3]
    radii: np.ndarray,  # float64 [L]
) -> np.ndarray:  # float64 [N]
    """Return the smallest t > 0 where each ray hits a disc; inf for a miss."""
    nearest = np.full(len(directions), np.inf)
    for j in range(len(radii)):
        nx, ny, nz = axes[j, 0], axes[j, 1], axes[j, 2]
        ox, oy, oz = origin[0] - centers[j, 0], origin[1] - centers[j, 1], origin[2] - centers[j, 2]
        height = ox * nx + oy * ny + oz * nz
        limit = radii[j] * radii[j]
        for i in range(len(directions)):
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            # Intersection with the disc's plane; infinite (a miss) if parallel.
            t = -height / (dx * nx + dy * ny + dz * nz)
            x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
            if t > 0.0 and t < nearest[i] and x * x + y * y + z * z <= limit:
                nearest[i] = t
    return nearest


@inline
def first_wave_crossing(
    start: np.ndarray,  # float64 [3]: u, v, w of the rays' origin
    directions: np.ndarray,  # float64 [N, 3], along u, v and w
    near: np.ndarray,  # float64 [N]
    far: np.ndarray,  # float64 [N]
    amplitude: float,
    wavelength: float,
    steps_per_wave: int,
    bisections: int,
) -> np.ndarray:  # float64 [N]
    """Return the first t from near to far where each ray crosses w = A sin(2 pi u / wavelength).

    Each ray marches in fractions of a wave until it is on the other side, then bisects; inf for a
    miss.
    """
    crossing = np.full(len(directions), np.inf)
    k = 2.0 * np.pi / wavelength
    for i in range(len(directions)):
        u, du = start[0], directions[i, 0]
        w, dw = start[2], directions[i, 2]
        step = wavelength / steps_per_wave / max(abs(du), 1e-12)
        low, high = near[i], near[i]
        above = w + low * dw > amplitude * np.sin(k * (u + low * du))
        crossed = False
        while high < far[i] and not crossed:
            low, high = high, min(high + step, far[i])
            crossed = (w + high * dw > amplitude * np.sin(k * (u + high * du))) != above
        if not crossed:
            continue
        for _ in range(bisections):
            middle = (low + high) / 2
            if (w + middle * dw > amplitude * np.sin(k * (u + middle * du))) == above:
                low = middle
            else:
                high = middle
        crossing[i] = high
    return crossing
