"""Part of a tile is read by its cells, and is what the whole tile has there."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st

from splatseed.progress import silent
from splatseed.scene import Scene
from splatseed.tiles import SceneSource, open_work
from splatseed.tiles.reading import read_rows
from splatseed.tiles.splitting import split
from splatseed.tiles.store import TileStore


@pytest.fixture(scope="module")
def store(sheet, tmp_path_factory):
    source = SceneSource(Scene(sheet))
    with open_work(tmp_path_factory.mktemp("store") / "OUT.tiles", {}) as (work, _):
        read_rows(work, source.chunks(97), source.count, source.trusted, silent)
        split(work, 60, 97, silent)
        yield TileStore(work)


place = st.floats(-2.0, 2.0, allow_subnormal=False)


@given(corners=st.tuples(*[place] * 6), tile=st.integers(0, 10**6))
def test_a_box_of_a_tile_holds_all_its_points_there(store, corners, tile):
    tile %= len(store)
    box = np.sort(np.reshape(corners, (2, 3)), axis=0)
    whole, part = store.points(tile), store.points(tile, box)
    inside = ((whole.xyz >= box[0]) & (whole.xyz <= box[1])).all(axis=1)
    # The box is rounded outwards: a point on its border may be there too.
    assert set(whole.rank[inside]) <= set(part.rank)
    wider = box + np.array([[-1e-6], [1e-6]])
    assert ((part.xyz >= wider[0]) & (part.xyz <= wider[1])).all()
    for name in ("xyz", "rgb", "trusted"):
        there = np.searchsorted(whole.rank, part.rank)
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[there])


def test_a_box_around_a_tile_gives_it_whole(store):
    for tile in range(len(store)):
        whole, part = store.points(tile), store.points(tile, store.bounds[tile])
        np.testing.assert_array_equal(part.rank, whole.rank)
