"""Every method against its slow, literal reference, fed with the same random numbers."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import splatseed as ss
from splatseed.upsample.splines import LAMBDAS

from . import references as slow
from .references_voronoi import voronoi

PAPER = {"frame": "world", "placement": "box", "clamp": None, "reject_isolated": False}
MLS, PSPLINE = slow.mls_surface, slow.pspline_surface
GCV = partial(slow.gcv_surface, candidates=LAMBDAS)


def on(fit, k, **options):
    return partial(slow.on_patches, patch=slow.Patch(fit, k, **options))


CASES = {
    "linear": (slow.linear, {}),
    "linear, paper": (partial(slow.linear, reject_isolated=False), {"profile": "paper"}),
    "triangle": (slow.triangle, {}),
    "triangle, paper": (partial(slow.triangle, reject_isolated=False), {"profile": "paper"}),
    "mls": (on(MLS, 16), {}),
    "mls, paper": (on(MLS, 10, **PAPER), {"profile": "paper"}),
    "mls, triangles": (on(MLS, 16, placement="triangle"), {"placement": "triangle"}),
    "mls, unclamped": (on(MLS, 16, clamp=None), {"clamp": None}),
    "mls, few": (on(MLS, 7), {"k": 7}),
    "spline": (on(PSPLINE, 25), {}),
    "spline, strong": (on(partial(PSPLINE, smoothing=3.0), 25), {"smoothing": 3.0}),
    "spline, box": (on(PSPLINE, 25, placement="box"), {"placement": "box"}),
    "spline, world": (on(PSPLINE, 25, frame="world"), {"frame": "world"}),
    "spline, paper": (on(slow.bicubic_surface, 25, **PAPER), {"profile": "paper"}),
    "voronoi": (voronoi, {}),
    "voronoi, paper": (partial(voronoi, box=True), {"profile": "paper"}),
}

NUM_NEW = 200
SEED = 5


def fast_and_slow(cloud, exact, method, reference, options):
    seeds = ss.upsample(cloud, method, num_points=len(cloud) + NUM_NEW, seed=SEED, **options)
    new = seeds.select(slice(len(cloud), None))
    return new, *reference(exact, NUM_NEW, np.random.default_rng(SEED))


@pytest.mark.filterwarnings("ignore:(?s).*storage space exceeds:UserWarning")  # s is inert
@pytest.mark.parametrize("case", CASES)
def test_each_point_is_where_the_equation_puts_it(case, wavy, wavy_exact):
    reference, options = CASES[case]
    new, xyz, rgb = fast_and_slow(wavy, wavy_exact, case.split(",")[0], reference, options)
    # float32 output: half a unit in the last place of coordinates up to the reference's largest
    tolerance = 1e-6 * max(1.0, np.abs(xyz).max())
    np.testing.assert_allclose(new.xyz, xyz, rtol=0, atol=tolerance)
    off = np.abs(new.rgb - rgb)
    assert off.max() <= 1  # a colour that falls on a half may round either way
    assert np.count_nonzero(off) <= 2


def test_cross_validation_chooses_as_the_hat_matrix_does(wavy, wavy_exact):
    new, xyz, _ = fast_and_slow(wavy, wavy_exact, "spline", on(GCV, 25), {"smoothing": "gcv"})
    same = np.abs(new.xyz - xyz).max(axis=1) < 1e-6
    assert same.mean() >= 0.99  # near-ties between candidates may fall either way


@pytest.mark.filterwarnings("ignore:(?s).*storage space exceeds:UserWarning")
@pytest.mark.parametrize("tilt", [0, 60, 90])
def test_fitpacks_smoothing_is_inert_at_the_papers_size(tilt, rng):
    # With 26 points there is room for no knot: whatever s, it is the least-squares bicubic.
    turn = Rotation.from_euler("x", tilt, degrees=True)
    flat = np.concatenate([rng.uniform(-1.0, 1.0, (25, 3)) * [1.0, 1.0, 0.1], np.zeros((1, 3))])
    local = turn.apply(flat)
    distance = np.sort(np.linalg.norm(local[:25], axis=1))
    places = rng.uniform(local.min(axis=0)[:2], local.max(axis=0)[:2], (50, 2))
    heights = [
        [slow.bicubic_surface(local, distance, s)(u, v) for u, v in places]
        for s in (1e-9, 0.1 * 25, 1e9)
    ]
    for other in heights[:2]:
        np.testing.assert_allclose(other, heights[2], rtol=1e-9)
