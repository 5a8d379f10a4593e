"""Solid textures: colour as a function of world position.

Notation: a texture maps points [N, 3] to display colours [N, 3] in 0..1; palettes [C, 3] are
indexed by 0..1. Colours do not depend on the view, so that corners match between images; the finest
details span a few pixels of the demo's photographs, to avoid aliasing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from splatseed.synthetic._kernels import noise_sum

Color = tuple[float, float, float]
Points = Float64[np.ndarray, "N 3"]
Texture = Callable[[Points], Points]
"""Maps points to colours in 0..1."""


@dataclass(frozen=True)
class Plain:
    """One colour everywhere, without features."""

    color: Color

    def __call__(self, xyz: Points) -> Points:
        return np.broadcast_to(np.array(self.color), np.shape(xyz))


@dataclass(frozen=True)
class Mottled:
    """Noise of several octaves, mapped to a palette."""

    palette: tuple[Color, ...]  # for noise from low to high
    frequency: Color  # cells per scene unit of the coarsest octave along x, y and z
    octaves: int = 4  # each of twice the frequency and 0.7 times the amplitude
    contrast: float = 2.2  # scales noise about its mean before the palette is read
    seed: int = 0  # selects the noise

    def __call__(self, xyz: Points) -> Points:
        noise = value_noise(xyz * np.array(self.frequency), self.octaves, self.seed)
        return _read_palette(self.palette, (noise - 0.5) * self.contrast + 0.5)


@dataclass(frozen=True)
class Tiles:
    """Bricks, boards or checks: cells of uniform colour, with joints and grain."""

    palette: tuple[Color, ...]  # of the cells
    cell: Color  # size along x, y and z in scene units
    grain: Mottled  # its palette is a factor on the colour
    joint: float = 0.0  # width of the dark joints in scene units
    seed: int = 0  # selects the colours

    def __call__(self, xyz: Points) -> Points:
        size = np.array(self.cell)
        # Offset, so that walls at round coordinates are not on a joint.
        position = xyz / size + 0.37
        colors = _read_palette(self.palette, value_noise(np.floor(position), 1, self.seed))
        from_joint = np.abs(position - np.round(position)) * size
        colors[(from_joint < self.joint / 2).any(axis=1)] *= 0.35
        return np.asarray(np.clip(colors * self.grain(xyz), 0.0, 1.0))


def _read_palette(palette: tuple[Color, ...], values: np.ndarray) -> np.ndarray:
    colors = np.array(palette)
    stops = np.linspace(0.0, 1.0, len(colors))
    return np.stack([np.interp(values, stops, channel) for channel in colors.T], axis=1)


def value_noise(
    xyz: Float[np.ndarray, "N 3"], octaves: int, seed: int
) -> Float64[np.ndarray, " N"]:
    """Return value noise in 0..1 with cells of size 1, 1/2, 1/4 ..., [N].

    Random values at lattice points are interpolated by smoothstep; each octave has 0.7 times the
    amplitude of the previous one.
    """
    return np.asarray(noise_sum(np.ascontiguousarray(xyz, np.float64), octaves, seed))
