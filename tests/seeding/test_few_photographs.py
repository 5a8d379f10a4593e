"""Seeds of few photographs: as dense as pixels, each surface once, and only where few."""

from __future__ import annotations

import numpy as np

import splatseed as ss
from splatseed.methods import source_code
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.seeding import few_photographs
from splatseed.seeding.photo_methods import Auto


def few(room: Scene, count: int) -> Scene:
    return room.replace(images=room.images[:count], points=PointCloud.empty(), tracks=None)


def test_few_photographs_have_a_seed_every_two_pixels_on_the_surfaces(room, room_capture):
    notes = []
    cloud = ss.upsample(few(room, 4), "auto", note=notes.append)
    assert "few-photographs" in {note.kind for note in notes}
    pixels = 4 * 160 * 120 / few_photographs.SPACING**2
    assert 0.3 * pixels < len(cloud) < pixels  # what several views see has one seed
    distance = room_capture.surfaces.distance(cloud.xyz.astype(np.float64))
    confirmed = cloud.source == source_code("stereo")
    assert confirmed.mean() > 0.5
    assert np.quantile(distance[confirmed], 0.75) < 0.05
    assert np.median(distance[~confirmed]) < 0.3
    assert set(np.unique(cloud.source)) == {source_code("stereo"), source_code("cover")}
    assert (cloud.confidence[confirmed] > cloud.confidence[~confirmed].max()).all()
    again = ss.upsample(few(room, 4), "auto")
    assert (again.xyz == cloud.xyz).all()


def test_more_photographs_have_sparse_seeds(room, monkeypatch):
    monkeypatch.setattr(few_photographs, "MAX_PHOTOGRAPHS", 3)
    notes = []
    cloud = ss.upsample(few(room, 4), "auto", note=notes.append)
    assert "few-photographs" not in {note.kind for note in notes}
    assert len(cloud) < 5000


def test_a_budget_limits_them(room):
    cloud = ss.upsample(few(room, 3), Auto(), budget=2000)
    assert 1500 < len(cloud) <= 2000
