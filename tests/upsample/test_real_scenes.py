"""Every method on real Structure-from-Motion clouds: the promises hold there too."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

import splatseed as ss


@pytest.fixture(scope="session", params=["fox", "fern"])
def real(request, scenes):
    return ss.load_scene(scenes / request.param).points


@pytest.mark.parametrize("method", ["linear", "triangle", "mls", "spline", "voronoi"])
def test_new_points_stay_near_the_originals(real, method):
    seeds = ss.upsample(real, method, ratio=4)
    new = seeds.xyz[len(real) :]
    assert seeds.xyz[: len(real)].tobytes() == real.xyz.tobytes()
    assert np.isfinite(new).all()
    tree = cKDTree(np.unique(real.xyz, axis=0))
    distance, nearest = tree.query(new)
    h = tree.query(tree.data, 7)[0][:, 1:].mean(axis=1)
    # Cells reach into empty room; the others keep to the surface.
    assert np.mean(distance > 3.0 * h[nearest]) < (0.02 if method == "voronoi" else 0.01)


@pytest.mark.parametrize("method", ["mls", "spline"])
def test_covering_patches_close_gaps(real, method):
    # Half of the originals, upsampled, come nearer to the other half than they were.
    known, held_out = real.select(slice(0, None, 2)), real.xyz[1::2]
    seeds = ss.upsample(known, method, ratio=8)
    before = cKDTree(known.xyz).query(held_out)[0]
    after = cKDTree(seeds.xyz).query(held_out)[0]
    assert np.median(after) < 0.75 * np.median(before)
