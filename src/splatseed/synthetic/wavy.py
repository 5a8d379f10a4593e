"""SineSheet: a corrugated sheet, the smooth curved surface without a closed-form distance.

Notation: in the sheet's frame (rows of ``frame``, origin at ``corner``) a point is (u, v, w) and
the sheet is w = height(u) = A sin(2 pi u / wavelength) for 0 <= u <= size[0], 0 <= v <= size[1].
Promise: distances and depths are refined by bisection to 1e-10 of the sheet's size.
A ray that only grazes a crest, entering and leaving within a 48th of a wave, may count as a miss.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from splatseed.synthetic.surfaces import slab_interval

_BISECTIONS = 36
"""Halvings of a bracket that starts as a small part of the sheet."""

_STEPS_PER_WAVE = 48
"""Steps of the march along a ray, per wavelength."""
_GRID_PER_WAVE = 32
"""Places along the profile from which the nearest point is bracketed."""
_CHUNK = 20_000
"""Points per pass, which bounds the memory of the grid of distances."""


@dataclass(frozen=True, eq=False)
class SineSheet:
    """A rectangle bent into a sine wave along its first axis.

    Args:
        corner: The point u = v = w = 0, [3].
        frame: The directions of u, v and w as rows, [3, 3].
        size: Extent in u and v, [2].
        amplitude: A, in scene units.
        wavelength: In scene units.
    """

    corner: Float64[np.ndarray, " 3"]
    frame: Float64[np.ndarray, "3 3"]
    size: Float64[np.ndarray, " 2"]
    amplitude: float
    wavelength: float

    def _height(self, u: np.ndarray) -> np.ndarray:
        return np.asarray(self.amplitude * np.sin(2.0 * np.pi / self.wavelength * u))

    def _slope(self, u: np.ndarray) -> np.ndarray:
        k = 2.0 * np.pi / self.wavelength
        return np.asarray(self.amplitude * k * np.cos(k * u))

    def _arc_length(self) -> tuple[np.ndarray, np.ndarray]:
        """A fine table of u and the arc length from 0 to u."""
        u = np.linspace(0.0, self.size[0], 4096)
        speed = np.hypot(1.0, self._slope((u[1:] + u[:-1]) / 2))
        return u, np.concatenate([[0.0], np.cumsum(speed * np.diff(u))])

    @property
    def area(self) -> float:
        """See ``Surface.area``."""
        return float(self._arc_length()[1][-1] * self.size[1])

    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """See ``Surface.distance``."""
        local = (np.asarray(xyz, np.float64) - self.corner) @ self.frame.T
        across = local[:, 1] - np.clip(local[:, 1], 0.0, self.size[1])
        in_profile = np.empty(len(local))
        for start in range(0, len(local), _CHUNK):
            part = slice(start, start + _CHUNK)
            in_profile[part] = self._profile_distance(local[part, 0], local[part, 2])
        return np.asarray(np.hypot(in_profile, across))

    def _profile_distance(self, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Distance in the (u, w) plane to the curve: a grid finds the basin, bisection the foot."""
        num = int(np.ceil(_GRID_PER_WAVE * self.size[0] / self.wavelength)) + 1
        grid = np.linspace(0.0, self.size[0], num)
        squared = (u[:, None] - grid) ** 2 + (w[:, None] - self._height(grid)) ** 2
        best = squared.argmin(axis=1)
        low = grid[np.maximum(best - 1, 0)]
        high = grid[np.minimum(best + 1, num - 1)]
        for _ in range(_BISECTIONS):
            foot = (low + high) / 2
            # Half the derivative of the squared distance, by u.
            rising = (foot - u) + (self._height(foot) - w) * self._slope(foot) > 0
            low, high = np.where(rising, low, foot), np.where(rising, foot, high)
        return np.asarray(np.hypot(u - high, w - self._height(high)))

    def sample(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """See ``Surface.sample``."""
        table_u, table_length = self._arc_length()
        u = np.interp(rng.random(num) * table_length[-1], table_length, table_u)
        local = np.stack([u, rng.random(num) * self.size[1], self._height(u)], axis=1)
        return np.asarray(self.corner + local @ self.frame)

    def intersect(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> Float64[np.ndarray, " N"]:
        """See ``Surface.intersect``."""
        start = self.frame @ (origin - self.corner)
        local = directions @ self.frame.T
        low = np.array([0.0, 0.0, -self.amplitude])
        near, far = slab_interval(start, local, low, np.array([*self.size, self.amplitude]))
        near = np.maximum(near, 0.0)
        inside = np.flatnonzero(near < far)
        t = np.full(len(directions), np.inf)
        t[inside] = self._first_crossing(start, local[inside], near[inside], far[inside])
        return t

    def _first_crossing(
        self, start: np.ndarray, directions: np.ndarray, near: np.ndarray, far: np.ndarray
    ) -> np.ndarray:
        """March from near to far, then bisect the first step whose ends lie on different sides.

        A step covers a fixed part of a wave, so that rays across the sheet need few.
        """
        at_start = self._above(start, directions, near)
        along_wave = np.maximum(np.abs(directions[:, 0]), 1e-12)
        step = self.wavelength / _STEPS_PER_WAVE / along_wave
        low, high = near.copy(), np.full(len(near), np.inf)
        active = np.arange(len(near))
        while len(active):
            t = np.minimum(low[active] + step[active], far[active])
            crossed = self._above(start, directions[active], t) != at_start[active]
            high[active[crossed]] = t[crossed]
            going = ~crossed & (t < far[active])
            low[active[going]] = t[going]
            active = active[going]
        hit = np.isfinite(high)
        high[hit] = self._bisect(start, directions[hit], low[hit], high[hit])
        return high

    def _bisect(
        self, start: np.ndarray, directions: np.ndarray, low: np.ndarray, high: np.ndarray
    ) -> np.ndarray:
        side = self._above(start, directions, low)
        for _ in range(_BISECTIONS):
            middle = (low + high) / 2
            before = self._above(start, directions, middle) == side
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        return high

    def _above(self, start: np.ndarray, directions: np.ndarray, t: np.ndarray) -> np.ndarray:
        """Whether the rays are above the wave at t, along w."""
        u, w = (start[i] + t * directions[:, i] for i in (0, 2))
        return np.asarray(w > self._height(u))

    def normals(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """See ``Surface.normals``."""
        slope = self._slope((xyz - self.corner) @ self.frame[0])
        normal = self.frame[2] - slope[:, None] * self.frame[0]
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))
