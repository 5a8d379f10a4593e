"""Analytic surfaces that can be measured, sampled and rendered.

Notation: a surface is a set of points in the world, scene units. A ray is ``origin`` [3] plus
``t`` times ``directions`` [N, 3], which need not have unit length: with directions that advance one
unit along the camera's z axis, ``t`` is planar z-depth. A ``frame`` [3, 3] holds three orthonormal
axes as rows, so ``(xyz - center) @ frame.T`` are local coordinates. Promise: float64 throughout;
distances are exact up to rounding, unsigned, and measured to the finite surface with its edges;
samples are uniform by area and lie on the surface up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64


class Surface(Protocol):
    """What the demo scene and the benchmarks need from a surface."""

    @property
    def area(self) -> float:
        """Area in squared scene units, each side of a sheet counted once."""
        ...

    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """Unsigned distance of each point to the nearest point of the surface, [N]."""
        ...

    def sample(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """Points drawn uniformly by area, [num, 3]."""
        ...

    def intersect(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> Float64[np.ndarray, " N"]:
        """The smallest t > 0 at which each ray meets the surface, [N]; inf where it misses."""
        ...

    def normals(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Unit normals at points on the surface, [N, 3], of either sign."""
        ...


def yaw_frame(degrees: float) -> Float64[np.ndarray, "3 3"]:
    """Axes turned by ``degrees`` about the world's z axis, as rows, [3, 3]."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def _first_hit(*candidates: tuple[np.ndarray, np.ndarray]) -> Float64[np.ndarray, " N"]:
    """The smallest positive t [N] among pairs (t, whether it is a hit); inf if there is none.

    Pairs, not a table: NumPy's reductions over an axis of two are many times slower.
    """
    hits = [np.where(ok & (t > 0), t, np.inf) for t, ok in candidates]
    return hits[0] if len(hits) == 1 else np.minimum(hits[0], hits[1])


@dataclass(frozen=True, eq=False)
class Rectangle:
    """A flat rectangle.

    Args:
        corner: One of its corners, [3].
        edge_u: First edge, from the corner, [3].
        edge_v: Second edge, from the corner, [3]; orthogonal to the first.
    """

    corner: Float64[np.ndarray, " 3"]
    edge_u: Float64[np.ndarray, " 3"]
    edge_v: Float64[np.ndarray, " 3"]

    @cached_property
    def size(self) -> Float64[np.ndarray, " 2"]:
        """Lengths of the two edges, [2]."""
        return np.array([np.linalg.norm(self.edge_u), np.linalg.norm(self.edge_v)])

    @cached_property
    def frame(self) -> Float64[np.ndarray, "3 3"]:
        """Unit edges and normal as rows, [3, 3]."""
        u, v = self.edge_u / self.size[0], self.edge_v / self.size[1]
        return np.stack([u, v, np.cross(u, v)])

    @property
    def area(self) -> float:
        """See ``Surface.area``."""
        return float(self.size.prod())

    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """See ``Surface.distance``."""
        local = (np.asarray(xyz, np.float64) - self.corner) @ self.frame.T
        local[:, :2] -= np.clip(local[:, :2], 0.0, self.size)
        return np.asarray(np.linalg.norm(local, axis=1))

    def sample(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """See ``Surface.sample``."""
        local = rng.random((num, 2)) * self.size
        return np.asarray(self.corner + local @ self.frame[:2])

    def intersect(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> Float64[np.ndarray, " N"]:
        """See ``Surface.intersect``."""
        offset = self.frame @ (origin - self.corner)
        local = directions @ self.frame.T
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -offset[2] / local[:, 2]
            u, v = (offset[i] + t * local[:, i] for i in (0, 1))
        inside = (u >= 0) & (u <= self.size[0]) & (v >= 0) & (v <= self.size[1])
        return _first_hit((t, inside))

    def normals(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """See ``Surface.normals``."""
        return np.broadcast_to(self.frame[2], np.shape(xyz))


@dataclass(frozen=True, eq=False)
class Box:
    """The six faces of a box.

    Args:
        center: Its centre, [3].
        half: Half of its extent along each axis of the frame, [3].
        frame: Its axes as rows, [3, 3].
    """

    center: Float64[np.ndarray, " 3"]
    half: Float64[np.ndarray, " 3"]
    frame: Float64[np.ndarray, "3 3"]

    @property
    def _face_areas(self) -> Float64[np.ndarray, " 3"]:
        """Area of one face normal to each axis, [3]."""
        return np.asarray(4.0 * self.half.prod() / self.half)

    @property
    def area(self) -> float:
        """See ``Surface.area``."""
        return float(2.0 * self._face_areas.sum())

    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """See ``Surface.distance``."""
        local = (np.asarray(xyz, np.float64) - self.center) @ self.frame.T
        beyond = np.abs(local) - self.half
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=1)
        return np.asarray(outside + np.maximum(-beyond.max(axis=1), 0.0))

    def sample(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """See ``Surface.sample``."""
        axis = rng.choice(3, num, p=self._face_areas / self._face_areas.sum())
        local = rng.uniform(-1.0, 1.0, (num, 3))
        local[np.arange(num), axis] = rng.choice([-1.0, 1.0], num)
        return np.asarray(self.center + (local * self.half) @ self.frame)

    def intersect(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> Float64[np.ndarray, " N"]:
        """See ``Surface.intersect``."""
        near, far = slab_interval(
            self.frame @ (origin - self.center), directions @ self.frame.T, -self.half, self.half
        )
        meets = near <= far
        return _first_hit((near, meets), (far, meets))

    def normals(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """See ``Surface.normals``."""
        local = (xyz - self.center) @ self.frame.T
        axis = (np.abs(local) - self.half).argmax(axis=1)
        return np.asarray(np.sign(local)[np.arange(len(xyz)), axis, None] * self.frame[axis])


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere.

    Args:
        center: Its centre, [3].
        radius: Its radius.
    """

    center: Float64[np.ndarray, " 3"]
    radius: float

    @property
    def area(self) -> float:
        """See ``Surface.area``."""
        return float(4.0 * np.pi * self.radius**2)

    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """See ``Surface.distance``."""
        to_center = np.linalg.norm(np.asarray(xyz, np.float64) - self.center, axis=1)
        return np.asarray(np.abs(to_center - self.radius))

    def sample(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """See ``Surface.sample``."""
        ray = rng.normal(size=(num, 3))
        unit = ray / np.linalg.norm(ray, axis=1, keepdims=True)
        return np.asarray(self.center + self.radius * unit)

    def intersect(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> Float64[np.ndarray, " N"]:
        """See ``Surface.intersect``."""
        offset = origin - self.center
        a = np.einsum("ij,ij->i", directions, directions)
        t0, t1, real = _roots(a, directions @ offset, offset @ offset - self.radius**2)
        return _first_hit((t0, real), (t1, real))

    def normals(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """See ``Surface.normals``."""
        return np.asarray((xyz - self.center) / self.radius)


@dataclass(frozen=True, eq=False)
class Cylinder:
    """The side of a cylinder, open at both ends.

    Args:
        center: The middle of its axis, [3].
        frame: Its axes as rows, the third along the cylinder, [3, 3].
        radius: Its radius.
        height: Its length.
    """

    center: Float64[np.ndarray, " 3"]
    frame: Float64[np.ndarray, "3 3"]
    radius: float
    height: float

    @property
    def area(self) -> float:
        """See ``Surface.area``."""
        return float(2.0 * np.pi * self.radius * self.height)

    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """See ``Surface.distance``."""
        local = (np.asarray(xyz, np.float64) - self.center) @ self.frame.T
        radial = np.hypot(local[:, 0], local[:, 1]) - self.radius
        beyond = np.maximum(np.abs(local[:, 2]) - self.height / 2, 0.0)
        return np.asarray(np.hypot(radial, beyond))

    def sample(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """See ``Surface.sample``."""
        angle = rng.uniform(0.0, 2.0 * np.pi, num)
        along = rng.uniform(-0.5, 0.5, num) * self.height
        local = np.stack([np.cos(angle) * self.radius, np.sin(angle) * self.radius, along], axis=1)
        return np.asarray(self.center + local @ self.frame)

    def intersect(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> Float64[np.ndarray, " N"]:
        """See ``Surface.intersect``."""
        offset = self.frame @ (origin - self.center)
        local = directions @ self.frame.T
        across = local[:, :2]
        a = np.einsum("ij,ij->i", across, across)
        t0, t1, real = _roots(a, across @ offset[:2], offset[:2] @ offset[:2] - self.radius**2)
        on_side = [
            real & (np.abs(offset[2] + t * local[:, 2]) <= self.height / 2) for t in (t0, t1)
        ]
        return _first_hit((t0, on_side[0]), (t1, on_side[1]))

    def normals(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """See ``Surface.normals``."""
        across = ((xyz - self.center) @ self.frame.T)[:, :2]
        return np.asarray(across @ self.frame[:2] / self.radius)


@dataclass(frozen=True)
class Union:
    """Several surfaces taken as one.

    Args:
        parts: The surfaces, at least one.
    """

    parts: tuple[Surface, ...]

    @property
    def area(self) -> float:
        """See ``Surface.area``."""
        return sum(part.area for part in self.parts)

    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
        """See ``Surface.distance``."""
        nearest = np.full(len(xyz), np.inf)
        for part in self.parts:
            np.minimum(nearest, part.distance(xyz), out=nearest)
        return nearest

    def sample(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """See ``Surface.sample``."""
        areas = np.array([part.area for part in self.parts])
        counts = rng.multinomial(num, areas / areas.sum())
        pieces = [part.sample(int(n), rng) for part, n in zip(self.parts, counts, strict=True)]
        return np.concatenate(pieces)

    def intersect(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> Float64[np.ndarray, " N"]:
        """See ``Surface.intersect``."""
        return self.intersect_parts(origin, directions)[0]

    def intersect_parts(
        self, origin: Float64[np.ndarray, " 3"], directions: Float64[np.ndarray, "N 3"]
    ) -> tuple[Float64[np.ndarray, " N"], Int64[np.ndarray, " N"]]:
        """As ``intersect``, and the index of the part that was hit, [N]; -1 where none was."""
        nearest = np.full(len(directions), np.inf)
        which = np.full(len(directions), -1)
        for i, part in enumerate(self.parts):
            t = part.intersect(origin, directions)
            which[t < nearest] = i
            np.minimum(nearest, t, out=nearest)
        return nearest, which

    def normals(self, xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """See ``Surface.normals``."""
        nearest = np.stack([part.distance(xyz) for part in self.parts]).argmin(axis=0)
        normals = np.empty(np.shape(xyz))
        for i, part in enumerate(self.parts):
            normals[nearest == i] = part.normals(xyz[nearest == i])
        return normals


def slab_interval(
    origin: Float64[np.ndarray, " 3"],
    directions: Float64[np.ndarray, "N 3"],
    low: Float64[np.ndarray, " 3"],
    high: Float64[np.ndarray, " 3"],
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"]]:
    """Where rays enter and leave the box low..high, in the box's axes; near > far for a miss."""
    near = np.full(len(directions), -np.inf)
    far = np.full(len(directions), np.inf)
    for i in range(3):
        with np.errstate(divide="ignore", invalid="ignore"):
            a = (low[i] - origin[i]) / directions[:, i]
            b = (high[i] - origin[i]) / directions[:, i]
        # A ray within a face's plane gives 0/0; fmin and fmax then let the other planes decide.
        near = np.fmax(near, np.fmin(a, b))
        far = np.fmin(far, np.fmax(a, b))
    return near, far


def _roots(
    a: Float64[np.ndarray, " N"], half_b: Float64[np.ndarray, " N"], c: float
) -> tuple[Float64[np.ndarray, " N"], Float64[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Both roots of a t² + 2 half_b t + c, [N] each, and whether they are real, [N].

    The product form of the smaller root avoids cancellation.
    """
    discriminant = half_b * half_b - a * c
    real = discriminant >= 0
    # One root is q / a; their product is c / a, so the other is c / q.
    q = -(half_b + np.copysign(np.sqrt(np.where(real, discriminant, 0.0)), half_b))
    with np.errstate(divide="ignore", invalid="ignore"):
        return q / a, c / q, real
