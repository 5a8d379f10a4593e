"""Principal axes: against an eigensolver, in every shape that a neighbourhood can take."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.upsample.patches import local_frames

from . import references as slow

STRETCHES = {
    "blob": (1.0, 0.7, 0.4),
    "patch": (1.0, 0.8, 0.01),
    "flat patch": (1.0, 0.8, 0.0),
    "stick": (1.0, 0.01, 0.005),
    "thin": (1.0, 1e-3, 1e-6),
}


def axes_of(points):
    """Frame and line flag of the first point with all others as its neighbours."""
    idx = np.array([[j for j in range(len(points)) if j != i] for i in range(len(points))])
    frames, collinear = local_frames(points, idx.astype(np.int32))
    return frames[0], bool(collinear[0])


def neighborhood(stretch, rng):
    turn = Rotation.random(random_state=int(rng.integers(1000)))
    return turn.apply(rng.normal(size=(17, 3)) * stretch)


@pytest.mark.parametrize("shape", STRETCHES)
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_axes_are_the_eigenvectors(shape, scale, rng):
    for _ in range(50):
        points = scale * neighborhood(STRETCHES[shape], rng)
        frame, collinear = axes_of(points)
        np.testing.assert_allclose(
            frame, slow.frame_at(points, 0, list(range(1, 17))), rtol=0, atol=1e-6
        )
        assert not collinear


@pytest.mark.parametrize("shape", [*STRETCHES, "line", "ball"])
def test_frames_are_right_handed_and_orthonormal(shape, rng):
    stretch = {**STRETCHES, "line": (1.0, 0.0, 0.0), "ball": (1.0, 1.0, 1.0)}[shape]
    for _ in range(20):
        frame, _ = axes_of(neighborhood(stretch, rng))
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), rtol=0, atol=1e-9)
        assert np.linalg.det(frame) > 0


def test_a_line_is_reported_with_its_direction(rng):
    for _ in range(20):
        points = neighborhood((1.0, 0.0, 0.0), rng)
        frame, collinear = axes_of(points)
        along = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
        assert collinear
        assert abs(frame[0] @ along) == pytest.approx(1.0)
