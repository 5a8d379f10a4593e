"""Points of features at known poses: on the surfaces, unmasked, and only where auto needs them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap")

import splatseed as ss
from splatseed.errors import MissingDependencyError
from splatseed.methods import source_code
from splatseed.pointcloud import PointCloud
from splatseed.projection import project
from splatseed.seeding import few_photographs
from splatseed.seeding.photo_methods import read_views
from splatseed.sfm import triangulation
from splatseed.sfm._kernels import match_along_lines


def silent(*_: object) -> None:
    """No progress."""


@pytest.fixture(scope="module")
def views(sixteen_views):
    scene = sixteen_views[1]
    return read_views(scene, scene.images, 800, silent)


@pytest.fixture
def bare(sixteen_views):
    return sixteen_views[1].replace(points=PointCloud.empty(), tracks=None)


@pytest.fixture(scope="module")
def points(views):
    return triangulation.triangulate(views)


def test_points_lie_on_the_surfaces(sixteen_views, views, points, monkeypatch):
    assert len(points) > 100
    distance = sixteen_views[0].surfaces.distance(points.xyz.astype(np.float64))
    assert np.median(distance) < 0.02
    assert np.quantile(distance, 0.9) < 0.1
    assert points.confidence.min() == pytest.approx(0.75)  # two further views
    monkeypatch.setattr(triangulation, "num_threads", lambda: 2)
    again = triangulation.triangulate(views)
    assert again.xyz.tobytes() == points.xyz.tobytes()
    assert again.rgb.tobytes() == points.rgb.tobytes()


def test_masked_pixels_have_no_points(views):
    mask = np.zeros((120, 160), np.bool_)
    mask[:, :80] = True
    points = triangulation.triangulate([replace(view, mask=mask) for view in views])
    assert len(points)
    shown = np.zeros(len(points), np.int64)
    for view in views:
        column, row, depth = project(view.camera.pixels_from_world, points.xyz)
        shown += (depth > 0) & (column > 0) & (column < 80.5) & (row > 0) & (row < 120)
    assert (shown >= 3).all()


def test_epipolar_lines_hold_what_both_views_see(views):
    xyz = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3))
    ones = np.ones((20, 1))
    matrix = triangulation._fundamental(views[0], views[1])
    uv, there = (
        np.stack(project(view.camera.pixels_from_world, xyz)[:2], axis=1) for view in views[:2]
    )
    lines = np.hstack([uv, ones]) @ matrix.T
    distance = (lines * np.hstack([there, ones])).sum(axis=1) / np.hypot(*lines[:, :2].T)
    np.testing.assert_allclose(distance, 0, atol=1e-6)


def test_the_best_match_is_near_the_line_and_clearly_the_best():
    # The line of a feature at row y is the row y.
    matrix = np.array([[0.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    others = np.array([[5.0, 11.0], [50.0, 10.5], [70.0, 60.0], [80.0, 60.0]])
    theirs = np.zeros((4, 128), np.uint8)
    theirs[0, 0], theirs[1, 1], theirs[2:, 2] = 200, 200, 200  # the last two are alike
    uv = np.array([[30.0, 10.0], [30.0, 10.0], [40.0, 60.0], [30.0, 15.0]])
    own = theirs[[0, 1, 2, 0]]
    out = np.empty(4, np.int64)
    match_along_lines(uv, own, others, theirs, matrix, (2.0, 0.7, 0.85), out)
    assert out.tolist() == [0, 1, -1, -1]


@pytest.mark.usefixtures("compare_once")
def test_auto_adds_them_where_there_are_no_points(bare, points, monkeypatch):
    def fail(*_):
        raise MissingDependencyError("pycolmap", found="none", fix="Get it")

    monkeypatch.setattr(few_photographs, "MAX_PHOTOGRAPHS", 12)  # so that 16 are many
    clouds, notes = [], {}
    for made in (lambda *_: points, fail):
        monkeypatch.setattr(triangulation, "triangulate", made)
        found = []
        clouds.append(ss.upsample(bare, "auto", note=found.append))
        notes |= {note.kind: note for note in found}
    both, stereo = clouds
    assert notes["triangulated-points"].text.startswith(f"{len(points):,} points")
    assert notes["points-not-triangulated"].fix == "Get it"
    assert both.xyz[: len(points)].tobytes() == points.xyz.tobytes()
    one, two = (cloud.xyz[cloud.source == source_code("stereo")] for cloud in clouds)
    assert one[len(points) :].tobytes() == two.tobytes()
    assert len(both) < len(stereo) + len(points)  # cover leaves their cells out


@pytest.mark.usefixtures("compare_once")
def test_auto_leaves_scenes_with_points_as_they_are(sixteen_views, monkeypatch):
    def fail(*_):
        raise AssertionError("not needed")

    monkeypatch.setattr(triangulation, "triangulate", fail)
    assert len(ss.upsample(sixteen_views[1], "auto"))
