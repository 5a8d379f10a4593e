"""Voronoi cells: the meshless ones against SciPy's, the boxed ones against equation 6."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed import PointCloud
from splatseed.methods._kernels.cells import MAX_NEIGHBORS, build_cells
from splatseed.methods.neighbors import prepare
from splatseed.methods.patches import local_frames
from splatseed.methods.voronoi import Cells, box_cells
from splatseed.progress import silent

from . import paper_equations as paper, references_voronoi as slow


def prepared(xyz):
    return prepare(PointCloud(np.asarray(xyz, np.float32), np.zeros(np.shape(xyz), np.uint8)))


def meshless(cloud, k):
    neighbors, n = cloud.neighbors(k), len(cloud)
    cells = Cells(np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n, bool))
    frames, _ = local_frames(cloud.xyz, neighbors.idx)
    build_cells(cloud.xyz, neighbors.idx, neighbors.distance, frames, 0, n, *cells)
    return cells, neighbors


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_closed_cells_are_the_voronoi_cells(scale, rng):
    cloud = prepared(scale * rng.random((600, 3)))
    cells, neighbors = meshless(cloud, MAX_NEIGHBORS)
    truth = slow.true_cells(cloud.xyz)
    assert cells.closed.mean() > 0.3
    for i in np.flatnonzero(cells.closed):
        center, radius, volume = truth[i]
        assert cells.volume[i] == pytest.approx(volume, rel=1e-9)
        if radius + np.linalg.norm(center - cloud.xyz[i]) < 0.5 * neighbors.distance[i, -1]:
            np.testing.assert_allclose(cloud.xyz[i] + cells.center[i], center, atol=1e-9 * scale)
            assert cells.radius[i] == pytest.approx(radius, rel=1e-9)


@pytest.mark.parametrize("k", [4, 10, 25])
def test_open_cells_are_cut_from_their_cube(k, wavy, wavy_exact):
    cloud = prepare(wavy)
    cells, _ = meshless(cloud, k)
    for row in range(0, len(cloud), 3):
        i = cloud.rank[row]
        center, radius, volume = slow.clamped_cell(wavy_exact.xyz, i, k)
        assert cells.volume[row] == pytest.approx(volume, rel=1e-6)
        np.testing.assert_allclose(
            wavy_exact.xyz[i] + cells.center[row], center, rtol=0, atol=1e-6 * radius
        )
        assert cells.radius[row] == pytest.approx(radius, rel=1e-6)


@pytest.mark.parametrize("shape", ["plane", "line", "lattice", "near twins", "ring"])
def test_cells_of_any_sites_are_bounded(shape, rng):
    angle = np.linspace(0.0, 2 * np.pi, 100, endpoint=False)
    xyz = {
        "plane": rng.random((200, 3)) * [1, 1, 0],
        "line": rng.random((200, 3)) * [1, 0, 0],
        "lattice": np.stack(np.meshgrid(*[np.arange(6.0)] * 3), axis=-1).reshape(-1, 3),
        "near twins": np.repeat(rng.random((100, 3)), 2, axis=0) + 1e-7 * rng.random((200, 3)),
        "ring": np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1),
    }[shape]
    cloud = prepared(xyz)
    cells, neighbors = meshless(cloud, 25)
    side = neighbors.distance[:, -1]
    assert (cells.volume > 0).all()
    assert (cells.volume <= side**3 * (1 + 1e-9)).all()
    assert (np.linalg.norm(cells.center, axis=1) <= 0.5 * side * (1 + 1e-9)).all()
    assert (cells.radius <= side * (1 + 1e-9)).all()


def test_boxed_cells_are_those_of_equation_6(rng):
    cloud = prepared(rng.random((150, 3)) * [3.0, 2.0, 1.0])
    center, radius, volume = box_cells(cloud, silent)
    expected_center, expected_radius, expected_volume = paper.voronoi(cloud.xyz)
    np.testing.assert_allclose(cloud.xyz + center, expected_center, rtol=0, atol=1e-9)
    np.testing.assert_allclose(radius, expected_radius, rtol=1e-9)
    np.testing.assert_allclose(volume, expected_volume, rtol=1e-9)
