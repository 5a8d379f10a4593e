"""Colours of new points: what inverse-distance weights promise."""

from __future__ import annotations

import numpy as np

from splatseed.upsample.colors import interpolate_colors
from splatseed.upsample.neighbors import draw_bases, prepare


def colors_at(cloud, place, k=5):
    """Colour of one new point per row, at ``place(row)`` relative to the base."""
    prepared = prepare(cloud)
    neighbors, n = prepared.neighbors(k), len(prepared)
    bases = draw_bases(prepared, n, np.random.default_rng(0), weight=np.ones(n))
    bases.count[:], bases.start[:] = 1, prepared.rank
    xyz = np.empty((n, 3), np.float32)
    xyz[bases.start] = place(prepared, neighbors) + prepared.center
    return interpolate_colors(prepared, neighbors, bases, xyz), xyz


def test_a_point_on_its_base_has_nearly_its_color(wavy):
    rgb, _ = colors_at(wavy, lambda prepared, _: prepared.xyz)
    assert np.abs(rgb.astype(int) - wavy.rgb).max() <= 255 * 5 * 0.01 * 2
    assert np.abs(rgb.astype(int) - wavy.rgb).mean() < 4


def test_a_point_midway_to_its_neighbor_mixes_both_equally(wavy):
    def middle(prepared, neighbors):
        return (prepared.xyz + prepared.xyz[neighbors.idx[:, 0]]) / 2

    rgb, xyz = colors_at(wavy, middle, k=1)
    distance = np.linalg.norm(wavy.xyz[None].astype(np.float64) - wavy.xyz[:, None], axis=2)
    np.fill_diagonal(distance, np.inf)
    expected = (wavy.rgb.astype(float) + wavy.rgb[distance.argmin(axis=1)]) / 2
    assert np.abs(rgb - expected).max() <= 1.0
    assert np.isfinite(xyz).all()


def test_one_color_stays_that_color(wavy):
    plain = wavy.replace(rgb=np.full_like(wavy.rgb, 255))
    rgb, _ = colors_at(plain, lambda prepared, _: prepared.xyz + 0.01)
    assert (rgb == 255).all()
