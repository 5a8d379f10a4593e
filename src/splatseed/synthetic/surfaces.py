"""Analytic surfaces with exact distances, uniform samples and ray intersections.

Notation: scene units. A ray is ``origin`` [3] + ``t`` * ``directions`` [N, 3], of any length: with
unit camera z, ``t`` is planar depth. A ``frame`` [3, 3] has orthonormal axes as rows, so that
``(xyz - center) @ frame.T`` are local coordinates. All is float64. Distances are unsigned, to the
finite surface with its edges, and exact up to rounding (``SineSheet``: 1e-10 of its size).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from splatseed.frozen import read_only_view
from splatseed.synthetic._kernels import first_disc, first_wave_crossing, nearest_disc

Vector = Float64[np.ndarray, " 3"]
Frame = Float64[np.ndarray, "3 3"]
Points = Float[np.ndarray, "N 3"]
"""Points, directions or normals."""
Numbers = Float64[np.ndarray, " N"]
"""One value per point or ray."""

_BISECTIONS = 36
"""Bisection steps on a sine sheet."""
_STEPS_PER_WAVE = 48
"""Ray marching steps per wavelength."""
_GRID_PER_WAVE = 32
"""Profile samples per wavelength, to bracket the nearest point."""
_CHUNK = 20_000
"""Points per pass, to bound the memory of the distance grid."""


class Surface(Protocol):
    """The interface of a surface."""

    @property
    def area(self) -> float:
        """Area in squared scene units; of sheets, one side."""

    def distance(self, xyz: Points) -> Numbers:
        """Return each point's unsigned distance to the surface, [N]."""

    def sample(self, num: int, rng: np.random.Generator) -> Points:
        """Sample points uniformly by area, [num, 3]."""

    def intersect(self, origin: Vector, directions: Points) -> Numbers:
        """Return the smallest t > 0 where each ray hits the surface, [N]; inf for a miss."""

    def normals(self, xyz: Points) -> Points:
        """Return unit normals at surface points, [N, 3], of either sign."""


def yaw_frame(degrees: float) -> Frame:
    """Return axes rotated about world z, as rows, [3, 3]."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Rectangle(Surface):
    """A flat rectangle."""

    corner: Vector  # one of the four
    edge_u: Vector  # from the corner
    edge_v: Vector  # likewise, orthogonal to the first

    @cached_property
    def size(self) -> Float64[np.ndarray, " 2"]:
        """Lengths of the two edges, [2]."""
        return np.array([np.linalg.norm(self.edge_u), np.linalg.norm(self.edge_v)])

    @cached_property
    def frame(self) -> Frame:
        """Unit edges and normal as rows, [3, 3]."""
        u, v = self.edge_u / self.size[0], self.edge_v / self.size[1]
        return np.stack([u, v, np.cross(u, v)])

    @property
    def area(self) -> float:
        return float(self.size.prod())

    def distance(self, xyz: Points) -> Numbers:
        local = (np.asarray(xyz, np.float64) - self.corner) @ self.frame.T
        local[:, :2] -= np.clip(local[:, :2], 0.0, self.size)
        return np.asarray(np.linalg.norm(local, axis=1))

    def sample(self, num: int, rng: np.random.Generator) -> Points:
        local = rng.random((num, 2)) * self.size
        return np.asarray(self.corner + local @ self.frame[:2])

    def intersect(self, origin: Vector, directions: Points) -> Numbers:
        offset = self.frame @ (origin - self.corner)
        local = directions @ self.frame.T
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -offset[2] / local[:, 2]
            u, v = (offset[i] + t * local[:, i] for i in (0, 1))
        inside = (u >= 0) & (u <= self.size[0]) & (v >= 0) & (v <= self.size[1])
        return _first_hit((t, inside))

    def normals(self, xyz: Points) -> Points:
        return np.broadcast_to(self.frame[2], np.shape(xyz))


@dataclass(frozen=True, eq=False)
class Box(Surface):
    """The six faces of a box."""

    center: Vector
    half: Vector  # half of its extent along each axis of the frame
    frame: Frame

    @property
    def area(self) -> float:
        return float(8.0 * (self.half.prod() / self.half).sum())

    def distance(self, xyz: Points) -> Numbers:
        local = (np.asarray(xyz, np.float64) - self.center) @ self.frame.T
        beyond = np.abs(local) - self.half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.maximum(-beyond.max(axis=1), 0.0))

    def sample(self, num: int, rng: np.random.Generator) -> Points:
        faces = 4.0 * self.half.prod() / self.half  # normal to each axis
        axis = rng.choice(3, num, p=faces / faces.sum())
        local = rng.uniform(-1.0, 1.0, (num, 3))
        local[np.arange(num), axis] = rng.choice([-1.0, 1.0], num)
        return np.asarray(self.center + (local * self.half) @ self.frame)

    def intersect(self, origin: Vector, directions: Points) -> Numbers:
        near, far = _slab_interval(
            self.frame @ (origin - self.center), directions @ self.frame.T, -self.half, self.half
        )
        meets = near <= far
        return _first_hit((near, meets), (far, meets))

    def normals(self, xyz: Points) -> Points:
        local = (xyz - self.center) @ self.frame.T
        axis = (np.abs(local) - self.half).argmax(axis=1)
        return np.asarray(np.sign(local)[np.arange(len(xyz)), axis, None] * self.frame[axis])


@dataclass(frozen=True, eq=False)
class Sphere(Surface):
    """A sphere."""

    center: Vector
    radius: float

    @property
    def area(self) -> float:
        return float(4.0 * np.pi * self.radius**2)

    def distance(self, xyz: Points) -> Numbers:
        to_center = np.linalg.norm(np.asarray(xyz, np.float64) - self.center, axis=1)
        return np.asarray(np.abs(to_center - self.radius))

    def sample(self, num: int, rng: np.random.Generator) -> Points:
        ray = rng.normal(size=(num, 3))
        unit = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return np.asarray(self.center + self.radius * unit)

    def intersect(self, origin: Vector, directions: Points) -> Numbers:
        offset = origin - self.center
        a = np.einsum("ij,ij->i", directions, directions)
        t0, t1, real = _roots(a, directions @ offset, offset @ offset - self.radius**2)
        return _first_hit((t0, real), (t1, real))

    def normals(self, xyz: Points) -> Points:
        return np.asarray((xyz - self.center) / self.radius)


@dataclass(frozen=True, eq=False)
class Cylinder(Surface):
    """The side of a cylinder, open at both ends."""

    center: Vector  # the middle of its axis
    frame: Frame  # the third axis along the cylinder
    radius: float
    height: float

    @property
    def area(self) -> float:
        return float(2.0 * np.pi * self.radius * self.height)

    def distance(self, xyz: Points) -> Numbers:
        local = (np.asarray(xyz, np.float64) - self.center) @ self.frame.T
        radial = np.hypot(local[:, 0], local[:, 1]) - self.radius
        beyond = np.maximum(np.abs(local[:, 2]) - self.height / 2, 0.0)
        return np.asarray(np.hypot(radial, beyond))

    def sample(self, num: int, rng: np.random.Generator) -> Points:
        angle = rng.uniform(0.0, 2.0 * np.pi, num)
        along = rng.uniform(-0.5, 0.5, num) * self.height
        local = np.stack([np.cos(angle) * self.radius, np.sin(angle) * self.radius, along], axis=1)
        return np.asarray(self.center + local @ self.frame)

    def intersect(self, origin: Vector, directions: Points) -> Numbers:
        offset = self.frame @ (origin - self.center)
        local = directions @ self.frame.T
        across = local[:, :2]
        a = np.einsum("ij,ij->i", across, across)
        t0, t1, real = _roots(a, across @ offset[:2], offset[:2] @ offset[:2] - self.radius**2)
        on_side = [
            real & (np.abs(offset[2] + t * local[:, 2]) <= self.height / 2) for t in (t0, t1)
        ]
        return _first_hit((t0, on_side[0]), (t1, on_side[1]))

    def normals(self, xyz: Points) -> Points:
        across = ((xyz - self.center) @ self.frame.T)[:, :2]
        return np.asarray(across @ self.frame[:2] / self.radius)


@dataclass(frozen=True)
class Union(Surface):
    """Several surfaces taken as one."""

    parts: tuple[Surface, ...]

    @property
    def area(self) -> float:
        return sum(part.area for part in self.parts)

    def distance(self, xyz: Points) -> Numbers:
        nearest = np.full(len(xyz), np.inf)
        for part in self.parts:
            np.minimum(nearest, part.distance(xyz), out=nearest)
        return nearest

    def sample(self, num: int, rng: np.random.Generator) -> Points:
        areas = np.array([part.area for part in self.parts])
        counts = rng.multinomial(num, areas / areas.sum())
        pieces = [part.sample(int(n), rng) for part, n in zip(self.parts, counts, strict=True)]
        return np.concatenate(pieces)

    def intersect(self, origin: Vector, directions: Points) -> Numbers:
        return self.intersect_parts(origin, directions)[0]

    def intersect_parts(
        self, origin: Vector, directions: Points
    ) -> tuple[Numbers, Int64[np.ndarray, " N"]]:
        """Intersect; also return the index of the part hit, [N], or -1."""
        nearest = np.full(len(directions), np.inf)
        which = np.full(len(directions), -1)
        for i, part in enumerate(self.parts):
            t = part.intersect(origin, directions)
            which[t < nearest] = i
            np.minimum(nearest, t, out=nearest)
        return nearest, which

    def normals(self, xyz: Points) -> Points:
        nearest = np.stack([part.distance(xyz) for part in self.parts]).argmin(axis=0)
        normals = np.empty(np.shape(xyz))
        for i, part in enumerate(self.parts):
            normals[nearest == i] = part.normals(xyz[nearest == i])
        return normals


@dataclass(frozen=True, eq=False)
class SineSheet(Surface):
    """A rectangle bent into a sine wave along its first axis.

    In its frame a point is (u, v, w), and the sheet is w = A sin(2 pi u / wavelength) for
    0 <= u <= size[0], 0 <= v <= size[1]. A ray that grazes a crest within 1/48 of a wave may
    count as a miss.
    """

    corner: Vector  # the point u = v = w = 0
    frame: Frame  # the directions of u, v and w
    size: Float64[np.ndarray, " 2"]  # extent in u and v
    amplitude: float  # A
    wavelength: float

    def _height(self, u: np.ndarray) -> np.ndarray:
        return np.asarray(self.amplitude * np.sin(2.0 * np.pi / self.wavelength * u))

    def _slope(self, u: np.ndarray) -> np.ndarray:
        k = 2.0 * np.pi / self.wavelength
        return np.asarray(self.amplitude * k * np.cos(k * u))

    def _arc_length(self) -> tuple[np.ndarray, np.ndarray]:
        """Tabulate the arc length from 0 to u."""
        u = np.linspace(0.0, self.size[0], 4096)
        speed = np.hypot(1.0, self._slope((u[1:] + u[:-1]) / 2))
        return u, np.concatenate([[0.0], np.cumsum(speed * np.diff(u))])

    @property
    def area(self) -> float:
        return float(self._arc_length()[1][-1] * self.size[1])

    def distance(self, xyz: Points) -> Numbers:
        local = (np.asarray(xyz, np.float64) - self.corner) @ self.frame.T
        across = local[:, 1] - np.clip(local[:, 1], 0.0, self.size[1])
        in_profile = np.empty(len(local))
        for start in range(0, len(local), _CHUNK):
            part = slice(start, start + _CHUNK)
            in_profile[part] = self._profile_distance(local[part, 0], local[part, 2])
        return np.asarray(np.hypot(in_profile, across))

    def _profile_distance(self, u: np.ndarray, w: np.ndarray) -> np.ndarray:
        """Return the distance to the curve in the (u, w) plane: grid search, then bisection."""
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

    def sample(self, num: int, rng: np.random.Generator) -> Points:
        table_u, table_length = self._arc_length()
        u = np.interp(rng.random(num) * table_length[-1], table_length, table_u)
        local = np.stack([u, rng.random(num) * self.size[1], self._height(u)], axis=1)
        return np.asarray(self.corner + local @ self.frame)

    def intersect(self, origin: Vector, directions: Points) -> Numbers:
        start = self.frame @ (origin - self.corner)
        local = directions @ self.frame.T
        low = np.array([0.0, 0.0, -self.amplitude])
        near, far = _slab_interval(start, local, low, np.array([*self.size, self.amplitude]))
        near = np.maximum(near, 0.0)
        inside = np.flatnonzero(near < far)
        t = np.full(len(directions), np.inf)
        t[inside] = first_wave_crossing(
            start,
            local[inside],
            near[inside],
            far[inside],
            self.amplitude,
            self.wavelength,
            _STEPS_PER_WAVE,
            _BISECTIONS,
        )
        return t

    def normals(self, xyz: Points) -> Points:
        slope = self._slope((xyz - self.corner) @ self.frame[0])
        normal = self.frame[2] - slope[:, None] * self.frame[0]
        return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


@dataclass(frozen=True, eq=False)
class Discs(Surface):
    """Flat round leaves."""

    centers: Float64[np.ndarray, "L 3"]
    axes: Float64[np.ndarray, "L 3"]  # unit normals
    radii: Float64[np.ndarray, " L"]

    @property
    def area(self) -> float:
        return float(np.pi * (self.radii**2).sum())

    @cached_property
    def _bound(self) -> Sphere:
        """A sphere around all leaves, which most rays miss."""
        center = (self.centers.min(axis=0) + self.centers.max(axis=0)) / 2
        reach = np.linalg.norm(self.centers - center, axis=1) + self.radii
        return Sphere(center, float(reach.max()) * (1 + 1e-9))

    def distance(self, xyz: Points) -> Numbers:
        return np.asarray(self._nearest(xyz)[0])

    def _nearest(self, xyz: np.ndarray) -> Any:
        points = np.ascontiguousarray(xyz, np.float64)
        return nearest_disc(read_only_view(points), self.centers, self.axes, self.radii)

    def sample(self, num: int, rng: np.random.Generator) -> Points:
        leaf = rng.choice(len(self.radii), num, p=self.radii**2 / (self.radii**2).sum())
        axis = self.axes[leaf]
        # The cross product with a random normal vector is uniform in angle.
        across = np.cross(axis, rng.normal(size=(num, 3)))
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        radius = self.radii[leaf] * np.sqrt(rng.random(num))
        return np.asarray(self.centers[leaf] + radius[:, None] * across)

    def intersect(self, origin: Vector, directions: Points) -> Numbers:
        t = np.full(len(directions), np.inf)
        near = np.flatnonzero(np.isfinite(self._bound.intersect(origin, directions)))
        t[near] = first_disc(origin, directions[near], self.centers, self.axes, self.radii)
        return t

    def normals(self, xyz: Points) -> Points:
        return np.asarray(self.axes[self._nearest(xyz)[1]])


def _first_hit(*candidates: tuple[np.ndarray, np.ndarray]) -> Numbers:
    """Return the smallest positive t [N] of pairs (t, is hit), else inf.

    Pairs, since NumPy's reductions over an axis of two are slow.
    """
    hits = [np.where(ok & (t > 0), t, np.inf) for t, ok in candidates]
    return hits[0] if len(hits) == 1 else np.minimum(hits[0], hits[1])


def _slab_interval(
    origin: Vector, directions: Points, low: Vector, high: Vector
) -> tuple[Numbers, Numbers]:
    """Return t where rays enter and leave an axis-aligned box; near > far for a miss."""
    near = np.full(len(directions), -np.inf)
    far = np.full(len(directions), np.inf)
    for i in range(3):
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (low[i] - origin[i]) / directions[:, i]
            b = (high[i] - origin[i]) / directions[:, i]
        # A ray in a face's plane gives 0/0, which fmin and fmax ignore.
        near = np.fmax(near, np.fmin(a, b))
        far = np.fmin(far, np.fmax(a, b))
    return near, far


def _roots(
    a: Numbers, half_b: Numbers, c: float
) -> tuple[Numbers, Numbers, Bool[np.ndarray, " N"]]:
    """Return both roots of a t² + 2 half_b t + c, and whether they are real, [N] each.

    The smaller root follows from their product, to avoid cancellation.
    """
    discriminant = half_b * half_b - a * c
    real = discriminant >= 0
    # One root is q / a; their product is c / a, so the other is c / q.
    q = -(half_b + np.copysign(np.sqrt(np.where(real, discriminant, 0.0)), half_b))
    with np.errstate(divide="ignore", invalid="ignore"):
        return q / a, c / q, real


def plane(tilt: float = 35.0, center: Vector | None = None) -> Rectangle:
    """Make a 2 x 2 square rotated by ``tilt`` degrees about x; 90 is a wall."""
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    edge_u, edge_v = np.array([2.0, 0.0, 0.0]), np.array([0.0, 2.0 * c, 2.0 * s])
    middle = np.zeros(3) if center is None else center
    return Rectangle(middle - (edge_u + edge_v) / 2, edge_u, edge_v)


def sine_sheet() -> SineSheet:
    """Make a 2 x 2 sheet with wavelength 0.6 and amplitude 0.1."""
    return SineSheet(np.array([-1.0, -1.0, 0.0]), np.eye(3), np.array([2.0, 2.0]), 0.1, 0.6)


def parallel_plates(gap: float = 0.1) -> Union:
    """Make two tilted 2 x 2 plates ``gap`` apart, whose neighbourhoods must not mix."""
    lower = plane()
    return Union((lower, plane(center=gap * lower.frame[2])))


def _box_corner() -> Union:
    x, y, z = yaw_frame(30.0)
    origin = np.zeros(3)
    return Union((Rectangle(origin, x, y), Rectangle(origin, y, z), Rectangle(origin, z, x)))


SHAPES: MappingProxyType[str, Callable[[], Surface]] = MappingProxyType(
    {
        "plane": plane,
        "sphere": lambda: Sphere(np.zeros(3), 1.0),
        "cylinder": lambda: Cylinder(np.zeros(3), yaw_frame(0.0), 0.5, 2.0),
        "sine sheet": sine_sheet,
        "parallel plates": parallel_plates,
        "box corner": _box_corner,
    }
)
"""Factories of unit-sized shapes near the origin, by name; each provokes one kind of error. Planes
are tilted, to expose methods that depend on world axes."""
