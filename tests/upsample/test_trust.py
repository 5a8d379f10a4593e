"""Points that few images saw and that reproject badly start no new points."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed import PointCloud, Scene, upsample
from splatseed.progress import silent
from splatseed.scene import Tracks
from splatseed.upsample import configure
from splatseed.upsample.neighbors import prepare, trusted_originals


def scene_with(lengths, errors):
    n = len(lengths)
    xyz = np.random.default_rng(0).random((n, 3)).astype(np.float32)
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    total = int(offsets[-1])
    tracks = Tracks(
        np.arange(1, n + 1),
        xyz.astype(np.float64),
        np.asarray(errors, np.float64),
        offsets,
        np.zeros(total, np.uint32),
        np.zeros(total, np.uint32),
    )
    return Scene(PointCloud(xyz, np.zeros((n, 3), np.uint8)), tracks=tracks)


MISTRUSTED = scene_with(np.full(300, 3), np.where(np.arange(300) == 7, 50.0, 0.5))


def test_short_and_bad_together_are_not_trusted():
    lengths, errors = [3, 3, 9, 9, 5], [0.5, 5.0, 0.5, 5.0, 0.5]
    assert trusted_originals(scene_with(lengths, errors)).tolist() == [
        True,
        False,
        True,
        True,
        True,
    ]


def test_unknown_errors_are_trusted():
    assert trusted_originals(scene_with([2, 2], [-1.0, -1.0])) is None
    assert trusted_originals(scene_with([2, 2, 2], [-1.0, 1.0, 1.0])).all()


def test_no_tracks_no_verdict():
    scene = scene_with([3, 3], [1.0, 1.0]).replace(tracks=None)
    assert trusted_originals(scene) is None


@pytest.mark.parametrize(("profile", "weight"), [("default", 0.0), ("paper", 1.0)])
def test_nothing_grows_from_a_mistrusted_point(profile, weight):
    cloud = prepare(MISTRUSTED.points, trusted_originals(MISTRUSTED))
    weights, _ = configure("linear", profile).weigh(cloud, cloud.neighbors(8), silent)
    assert weights[cloud.rank == 7] == weight


def test_a_scene_is_upsampled_by_what_its_tracks_say():
    with_tracks = upsample(MISTRUSTED, "linear", ratio=20)
    without = upsample(MISTRUSTED.points, "linear", ratio=20)
    assert not np.array_equal(with_tracks.xyz, without.xyz)
    assert np.array_equal(with_tracks.xyz[:300], without.xyz[:300])
