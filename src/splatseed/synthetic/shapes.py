"""Fixed shapes on which methods are measured, made of ``surfaces``."""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType

import numpy as np

from splatseed.synthetic.surfaces import (
    Cylinder,
    Rectangle,
    SineSheet,
    Sphere,
    Surface,
    Union,
    Vector,
    yaw_frame,
)


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
    """Make three unit squares that meet at a corner with right angles."""
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
