"""Every method against its slow reference, fed with the same random numbers.

Profile ``paper`` is held to the paper's equations in ``test_paper_equations``.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

import splatseed as ss

from . import references as slow
from .references_voronoi import voronoi

MLS, PSPLINE = slow.mls_surface, slow.pspline_surface


def on(fit, k, **options):
    return partial(slow.on_patches, patch=slow.Patch(fit, k, **options))


CASES = {
    "linear": (slow.linear, {}),
    "triangle": (slow.triangle, {}),
    "mls": (on(MLS, 16), {}),
    "mls, triangles": (on(MLS, 16, placement="triangle"), {"placement": "triangle"}),
    "mls, unclamped": (on(MLS, 16, clamp=None), {"clamp": None}),
    "mls, few": (on(MLS, 7), {"k": 7}),
    "spline": (on(PSPLINE, 25), {}),
    "spline, strong": (on(partial(PSPLINE, smoothing=3.0), 25), {"smoothing": 3.0}),
    "spline, box": (on(PSPLINE, 25, placement="box"), {"placement": "box"}),
    "spline, world": (on(PSPLINE, 25, frame="world"), {"frame": "world"}),
    "voronoi": (voronoi, {}),
}

NUM_NEW = 100
SEED = 5


def fast_and_slow(cloud, exact, method, reference, options):
    seeds = ss.upsample(cloud, method, num_points=len(cloud) + NUM_NEW, seed=SEED, **options)
    new = seeds.select(slice(len(cloud), None))
    return new, *reference(exact, NUM_NEW, np.random.default_rng(SEED))


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
