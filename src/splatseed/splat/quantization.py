"""Quantise quaternions, opacities and colours, as packed formats of Gaussians do.

Notation: quaternions are wxyz. *Smallest three* stores a unit quaternion as the index of its
largest component, made positive, and the other three, each within 1/sqrt(2) of 0.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int64, UInt8

SH_COUNTS = (0, 3, 8, 15)
"""Coefficients beyond the first, by the degree of the spherical harmonics."""
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The remaining components, by the index of the largest."""


def smallest_three(
    quats: Float32[np.ndarray, "N 4"],
) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, "N 3"]]:
    """Return the index of each quaternion's largest component, and the other three in order."""
    unit = unit_quats(quats)
    largest = np.argmax(np.abs(unit), axis=1)
    rows = np.arange(len(unit))
    unit *= np.where(unit[rows, largest] < 0, -1, 1).astype(np.float32)[:, None]
    return largest, unit[rows[:, None], _OTHERS[largest]]


def from_smallest_three(
    largest: Int64[np.ndarray, " N"], three: Float32[np.ndarray, "N 3"]
) -> Float32[np.ndarray, "N 4"]:
    """Decode the unit quaternions of ``smallest_three``."""
    rows = np.arange(len(three))
    quats = np.empty((len(three), 4), np.float32)
    quats[rows[:, None], _OTHERS[largest]] = three
    # A unit quaternion: the fourth square is 1 minus the other three.
    quats[rows, largest] = np.sqrt(np.maximum(1 - (three**2).sum(axis=1), 0))
    return quats


def opacity_bytes(logits: Float32[np.ndarray, " N"]) -> UInt8[np.ndarray, " N"]:
    """Convert logits to opacities in steps of 1/255."""
    with np.errstate(over="ignore"):
        return np.rint(255 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.uint8)


def opacity_logits(values: UInt8[np.ndarray, " N"]) -> Float32[np.ndarray, " N"]:
    """Convert opacities in steps of 1/255 to logits; 0 and 1 move inwards by a quarter step."""
    opacity = np.clip(values / 255, 0.25 / 255, 1 - 0.25 / 255)
    return np.log(opacity / (1 - opacity)).astype(np.float32)


def rounded_bytes(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    """Round values to bytes, clipped to 0 to 255."""
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def unit_quats(quats: Float32[np.ndarray, "N 4"]) -> Float32[np.ndarray, "N 4"]:
    """Normalise quaternions; those of length 0 become the identity."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    known = np.isfinite(norms) & (norms > 0)
    unit = np.divide(quats, norms, out=np.zeros_like(quats), where=known)
    unit[~known[:, 0]] = (1, 0, 0, 0)
    return np.asarray(unit)
