"""Seeds in proportion to detail, and planes refined on larger photographs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.depth.stereo import detail
from splatseed.depth.stereo.detail import expected_spacing, fuse_at_most
from splatseed.depth.stereo.maps import StereoSettings
from splatseed.depth.stereo.pipeline import compare_closer, find_stereo
from splatseed.photos.loading import load_views
from splatseed.photos.visibility import find_visibility
from splatseed.progress import silent
from splatseed.synthetic.texture import Mottled

from ...seeds_of_views import seeds_of_views
from .made import arc, photograph, relative_error, tilted_plane

FAINT = Mottled(((0.45,) * 3, (0.55,) * 3), (7.0, 7.0, 7.0), octaves=3, contrast=3.0)
SHARP = Mottled(((0.0,) * 3, (1.0,) * 3), (7.0, 7.0, 7.0), octaves=3, contrast=6.0)
PATCH = 0.35
"""Half the side of the square of a wall that has a sharp texture, scene units."""
LARGEST = 12.0
NONE = ((np.empty((0, 2)), np.empty(0)),) * 5


def in_patch(xyz):
    """Whether points of the wall lie in its patch."""
    return (np.abs(xyz[:, :2]) < PATCH).all(axis=1)


def patched(xyz):
    """A faint texture with one sharp patch."""
    return np.where(in_patch(xyz)[:, None], SHARP(xyz), FAINT(xyz))


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """What stereo finds on a wall with a patch."""
    surfaces = tilted_plane(0.0)
    scene = photograph(tmp_path_factory.mktemp("wall"), surfaces, arc(), texture=patched)
    views = load_views(scene, scene.images)
    visibility = find_visibility(scene)
    return find_stereo(views, scene.images, visibility, StereoSettings(grid=1, sweeps=2))


def test_seeds_are_closest_together_where_contrast_is_high(wall, monkeypatch):
    """At equal number; sizes are those of the cells."""
    dense = fuse_at_most(wall, 1500, LARGEST, NONE, 4.0)
    monkeypatch.setattr(detail, "DETAIL", dataclasses.replace(detail.DETAIL, exponent=0.0))
    even = fuse_at_most(wall, 1500, LARGEST, NONE, 4.0)
    assert 1400 < len(even) <= 1500
    assert 1400 < len(dense) <= 1500
    assert in_patch(dense.xyz).mean() > 2 * in_patch(even.xyz).mean()
    patch = in_patch(dense.xyz)
    assert np.median(dense.sizes[patch]) < 0.6 * np.median(dense.sizes[~patch])
    # The wall around it has a seed in every largest cell still, where it is confirmed.
    cell = LARGEST * 3.0 / 100.0
    near = np.linalg.norm(even.xyz[:, None] - dense.xyz, axis=2).min(axis=1)
    assert np.quantile(near, 0.99) < 1.5 * cell


def test_the_number_is_met_and_the_guess_is_near(wall):
    for num in (800, 3000):
        spacing, finest = expected_spacing(wall, num, LARGEST)
        assert finest <= spacing * 1.01
        seeds = fuse_at_most(wall, num, LARGEST, NONE, spacing)
        assert 0.95 * num < len(seeds) <= num
    shares = []
    far_guess = fuse_at_most(wall, 800, LARGEST, NONE, 99.0, lambda _, share: shares.append(share))
    assert 0.95 * 800 < len(far_guess) <= 800
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    everything = fuse_at_most(wall, 10**9, LARGEST, NONE, 4.0)
    assert len(everything) > 4000
    assert len(np.unique(everything.xyz, axis=0)) == len(everything)
    few = fuse_at_most(wall, 1, LARGEST, NONE, 4.0)  # no fewer than one a largest cell
    assert 40 < len(few) < 400


def test_no_seed_lies_on_a_known_point(wall):
    num, spacing = 1500, 4.0
    before = fuse_at_most(wall, num, LARGEST, NONE, spacing)
    xyz = before.xyz[::3].astype(float)
    known = [view.camera.project(xyz) for view in wall.views]
    inside = [((uv >= 0) & (uv < (v.width, v.height))).all(axis=1) & (z > 0)
              for v, (uv, z) in zip(wall.views, known, strict=True)]  # fmt: skip
    known = [(uv[i], z[i]) for (uv, z), i in zip(known, inside, strict=True)]
    after = fuse_at_most(wall, num, LARGEST, known, spacing)
    taken = {tuple(row) for row in before.xyz[::3].tolist()}
    assert not taken & {tuple(row) for row in after.xyz.tolist()}
    assert len(after) > 0.9 * num  # elsewhere, closer together


def test_larger_photographs_refine_the_planes_of_smaller_ones(tmp_path):
    """Depths at every second pixel are as accurate as those found on the small photographs."""
    surfaces = tilted_plane(20.0)
    large = photograph(tmp_path, surfaces, arc(size=(192, 160), focal=200.0))
    small, views = (load_views(large, large.images, data_factor=n) for n in (2, 1))
    coarse = find_stereo(small, large.images, find_visibility(large), StereoSettings())
    stages = []
    fine = compare_closer(coarse, views, 2, 0, lambda *step: stages.append(step[0]))
    assert {"compare photographs again", "compare depths again"} == set(stages)
    assert fine.costs[0].shape == (80, 96)
    for i in range(5):
        before, after = coarse.map(i), fine.map(i)
        assert after.known_fraction > before.known_fraction - 0.05
        error = relative_error(surfaces, after)
        assert np.median(error) < np.median(relative_error(surfaces, before))
        assert (error < 0.01).mean() > 0.97
    again = compare_closer(coarse, views, 2, 0, silent)
    assert again.planes[3].tobytes() == fine.planes[3].tobytes()


def test_places_within_a_pixel_lie_on_its_plane(plane):
    (whole, _), (half, view_idx) = (
        seeds_of_views(
            detail,
            lambda _stereo, i, _places: i,
            lambda split=split: fuse_at_most(plane.stereo, 10**9, LARGEST, NONE, 0.2, split=split),
        )
        for split in (1, 2)
    )
    assert len(half) > 2 * len(whole)
    off = [plane.surfaces.distance(seeds.xyz.astype(float)) for seeds in (whole, half)]
    assert np.quantile(off[1], 0.9) < 1.1 * np.quantile(off[0], 0.9)
    assert np.median(half.sizes) == pytest.approx(0.5 * np.median(whole.sizes), rel=0.05)
    # Colours are those of the places.
    view = plane.stereo.views[0]
    uv = view.camera.project(half.xyz[view_idx == 0].astype(float))[0]
    column, row = np.floor(uv + 1e-3).astype(int).T
    same = (view.photograph[row, column] == half.rgb[view_idx == 0]).all(axis=1)
    assert same.mean() > 0.99


def test_two_views_suffice_for_the_largest_cells_only(wall):
    strong = fuse_at_most(wall, 10**9, LARGEST, NONE, 1.0)
    bits = [each & np.uint8(3) for each in wall.agreeing]
    weak = fuse_at_most(dataclasses.replace(wall, agreeing=bits), 10**9, LARGEST, NONE, 1.0)
    assert 0 < len(weak) < 0.1 * len(strong)
    assert weak.sizes.min() > 0.9 * LARGEST * 2.8 / 100
