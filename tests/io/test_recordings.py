"""Frames of a film are chosen by sharpness and motion."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.io.recordings import FILM, choose_frames, choose_photographs, pose_motion


def turned(degrees):
    """World from cameras that turn about y."""
    a = np.deg2rad(np.asarray(degrees, float))
    rotations = np.zeros((len(a), 3, 3))
    rotations[:, 0, 0], rotations[:, 0, 2], rotations[:, 1, 1] = np.cos(a), np.sin(a), 1
    rotations[:, 2, 0], rotations[:, 2, 2] = -np.sin(a), np.cos(a)
    return rotations


def test_motion_is_that_of_the_picture():
    """A picture that covers 2 atan(1 / 2) has a focal length of one width."""
    still = np.zeros((3, 3))
    np.testing.assert_allclose(
        pose_motion(turned([0, 3, 1]), still, 1.0), np.deg2rad([0, 3, 5]), rtol=1e-9
    )
    steps = np.array([[0, 0, 0], [0.5, 0, 0], [0.5, 0, -0.5]])
    walked = pose_motion(turned([0, 0, 0]), steps, 0.8)
    np.testing.assert_allclose(walked, 0.8 * np.array([0, 0.5, 1.0]) / FILM.distance)
    assert not len(pose_motion(np.zeros((0, 3, 3)), np.zeros((0, 3)), 1.0))


def test_the_sharpest_in_equal_intervals_of_motion():
    motion = np.concatenate([np.zeros(50), np.linspace(0, 1, 51)[1:]])  # stands, then moves
    sharpness = np.zeros(100)
    sharpness[[10, 60, 80, 81, 99]] = 1, 1, 1, 2, 1
    assert choose_frames(sharpness, motion, 4).tolist() == [10, 62, 81, 99]
    assert len(choose_frames(sharpness, motion, 10_000)) == pytest.approx(1 / FILM.min_step, abs=1)
    assert choose_frames(sharpness, np.zeros(100), 4).tolist() == [81]
    assert not len(choose_frames(np.zeros(0), np.zeros(0), 4))


def test_a_recording_of_usual_length_is_used_whole(rng):
    for count, chosen in ((FILM.max_photographs, FILM.max_photographs), (2000, 500)):
        centers = np.linspace([0, 0, 0], [90, 0, 0], count)
        found = choose_photographs(rng.random(count), turned(np.zeros(count)), centers, 0.8)
        assert len(found) == chosen
        assert (np.diff(found) > 0).all()
