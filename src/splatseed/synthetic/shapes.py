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
    """A 2 x 2 square turned by ``tilt`` degrees about the x axis; 90 makes it a wall."""
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    edge_u, edge_v = np.array([2.0, 0.0, 0.0]), np.array([0.0, 2.0 * c, 2.0 * s])
    middle = np.zeros(3) if center is None else center
    return Rectangle(middle - (edge_u + edge_v) / 2, edge_u, edge_v)


def sine_sheet() -> SineSheet:
    """A 2 x 2 sheet of three and a third waves with an amplitude of 0.1."""
    return SineSheet(np.array([-1.0, -1.0, 0.0]), np.eye(3), np.array([2.0, 2.0]), 0.1, 0.6)


def parallel_plates(gap: float = 0.1) -> Union:
    """Two tilted 2 x 2 plates ``gap`` apart: neighbours on one must not mix with the other's."""
    lower = plane()
    return Union((lower, plane(center=gap * lower.frame[2])))


def _box_corner() -> Union:
    """Three unit squares that meet at right angles: a corner and three edges."""
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
"""Makers of shapes of about unit size near the origin, by name, each of which provokes one kind of
error; what is flat is tilted, as that reveals methods that work in world axes."""
