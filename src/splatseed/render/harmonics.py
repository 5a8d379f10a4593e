"""Colour by direction: real spherical harmonics up to degree 3, and their gradient.

Basis, order and signs are those of 3D Gaussian Splatting and gsplat (P.-P. Sloan, Efficient Spherical
Harmonic Evaluation, 2013). The direction runs from the camera to the Gaussian and is normalised here.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from splatseed.jit import always_inline, kernel, parallel_range

__all__ = ["MAX_DEGREE", "harmonics", "harmonics_vjp"]

MAX_DEGREE = 3
TERMS = 16
CHUNKS = 64
"""Pieces that threads take, each with working arrays of its own."""
Y0 = 0.2820947917738781
Y1 = 0.48860251190292
Y2A, Y2B, Y2C = 1.0925484305920792, 0.9461746957575601, 0.5462742152960396
Y2D = 0.3153915652525201
Y3A, Y3B, Y3C = 0.5900435899266435, 2.890611442640554, 0.4570457994644658
Y3D, Y3E = 0.3731763325901154, 1.445305721320277


@kernel
def harmonics(directions, base, rest, shift, visible, terms, colors):  # type: ignore[no-untyped-def]
    """Colours of N Gaussians.

    Args:
        directions: float32 [N, 3], of any length.
        base: float32 [N, 1 or K, 3].
        rest: float32 [N, K - shift, 3].
        shift: 0 or 1.
        visible: bool [N]; colours of others are 0.
        terms: How many of the K take part: (degree + 1)^2.
        colors: Written, float32 [N, 3].
    """
    for chunk in parallel_range(CHUNKS):
        basis = np.empty(TERMS)
        for i in range(chunk * len(directions) // CHUNKS, (chunk + 1) * len(directions) // CHUNKS):
            colors[i, 0] = colors[i, 1] = colors[i, 2] = 0.0
            if visible[i]:
                x, y, z, _ = _unit(directions[i])
                _basis(x, y, z, terms, basis)
                for channel in range(3):
                    total = basis[0] * base[i, 0, channel]
                    for k in range(1, terms):
                        total += basis[k] * rest[i, k - shift, channel]
                    colors[i, channel] = total


@kernel
def harmonics_vjp(  # type: ignore[no-untyped-def]
    directions, rest, shift, visible, terms, d_colors, d_directions, d_base, d_rest
):
    """Gradients of ``harmonics``.

    Args:
        directions: As in ``harmonics``.
        rest: [N, K - shift, 3].
        shift: 0 or 1.
        visible: [N].
        terms: (degree + 1)^2.
        d_colors: d loss / d colors, float32 [N, 3].
        d_directions: Written, float32 [N, 3]; must hold 0.
        d_base: Written, float32 [N, 1 or K, 3]; must hold 0.
        d_rest: Written, float32 like ``rest``; must hold 0.
    """
    for chunk in parallel_range(CHUNKS):
        basis, slope, weight = np.empty(TERMS), np.zeros((3, TERMS)), np.empty(TERMS)
        for i in range(chunk * len(directions) // CHUNKS, (chunk + 1) * len(directions) // CHUNKS):
            if visible[i]:
                x, y, z, length = _unit(directions[i])
                _basis(x, y, z, terms, basis)
                _slopes(x, y, z, terms, slope)
                for channel in range(3):
                    d_base[i, 0, channel] = basis[0] * d_colors[i, channel]
                for k in range(1, terms):
                    weight[k] = 0.0
                    for channel in range(3):
                        d_rest[i, k - shift, channel] = basis[k] * d_colors[i, channel]
                        weight[k] += rest[i, k - shift, channel] * np.float64(d_colors[i, channel])
                dx = dy = dz = 0.0
                for k in range(1, terms):
                    dx += weight[k] * slope[0, k]
                    dy += weight[k] * slope[1, k]
                    dz += weight[k] * slope[2, k]
                along = dx * x + dy * y + dz * z
                d_directions[i, 0] = (dx - along * x) / length
                d_directions[i, 1] = (dy - along * y) / length
                d_directions[i, 2] = (dz - along * z) / length


@always_inline
def _unit(direction):  # type: ignore[no-untyped-def]
    x, y, z = np.float64(direction[0]), np.float64(direction[1]), np.float64(direction[2])
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    return x / length, y / length, z / length, length


@always_inline
def _basis(x, y, z, terms, out):  # type: ignore[no-untyped-def]
    """The basis functions at a unit direction."""
    out[0] = Y0
    if terms > 1:
        out[1], out[2], out[3] = -Y1 * y, Y1 * z, -Y1 * x
    if terms > 4:
        out[4], out[5], out[6] = Y2A * x * y, -Y2A * y * z, Y2B * z * z - Y2D
        out[7], out[8] = -Y2A * x * z, Y2C * (x * x - y * y)
    if terms > 9:
        out[9] = -Y3A * y * (3.0 * x * x - y * y)
        out[10] = Y3B * x * y * z
        out[11] = -Y3C * y * (5.0 * z * z - 1.0)
        out[12] = Y3D * z * (5.0 * z * z - 3.0)
        out[13] = -Y3C * x * (5.0 * z * z - 1.0)
        out[14] = Y3E * z * (x * x - y * y)
        out[15] = -Y3A * x * (x * x - 3.0 * y * y)


@always_inline
def _slopes(x, y, z, terms, out):  # type: ignore[no-untyped-def]
    """Derivatives of ``_basis`` along x, y and z; ``out`` holds 0."""
    if terms > 1:
        out[1, 1], out[2, 2], out[0, 3] = -Y1, Y1, -Y1
    if terms > 4:
        out[0, 4], out[1, 4] = Y2A * y, Y2A * x
        out[1, 5], out[2, 5] = -Y2A * z, -Y2A * y
        out[2, 6] = 2.0 * Y2B * z
        out[0, 7], out[2, 7] = -Y2A * z, -Y2A * x
        out[0, 8], out[1, 8] = 2.0 * Y2C * x, -2.0 * Y2C * y
    if terms > 9:
        out[0, 9], out[1, 9] = -6.0 * Y3A * x * y, -3.0 * Y3A * (x * x - y * y)
        out[0, 10], out[1, 10], out[2, 10] = Y3B * y * z, Y3B * x * z, Y3B * x * y
        out[1, 11], out[2, 11] = -Y3C * (5.0 * z * z - 1.0), -10.0 * Y3C * y * z
        out[2, 12] = Y3D * (15.0 * z * z - 3.0)
        out[0, 13], out[2, 13] = -Y3C * (5.0 * z * z - 1.0), -10.0 * Y3C * x * z
        out[0, 14], out[1, 14] = 2.0 * Y3E * x * z, -2.0 * Y3E * y * z
        out[2, 14] = Y3E * (x * x - y * y)
        out[0, 15], out[1, 15] = -3.0 * Y3A * (x * x - y * y), 6.0 * Y3A * x * y
