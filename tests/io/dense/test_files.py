"""The bytes of COLMAP's dense maps and graphs, and depth along rays half a pixel off."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp

from splatseed.camera import Camera
from splatseed.io.dense.colmap_files import (
    consistency_records,
    write_consistency_graph,
    write_map,
)
from splatseed.io.dense.maps import depth_along, scaled_K
from splatseed.io.depth.arrays import read_colmap_depth
from splatseed.stereo import StereoMap


def test_a_depth_map_byte_by_byte(tmp_path):
    values = np.array([[1.5, np.nan, 2.0], [0.25, 3.0, np.nan]], np.float32)
    write_map(tmp_path / "sub" / "a.bin", values)
    data = (tmp_path / "sub" / "a.bin").read_bytes()
    assert data == b"3&2&1&" + struct.pack("<6f", 1.5, 0, 2, 0.25, 3, 0)
    read = read_colmap_depth(tmp_path / "sub" / "a.bin").values
    np.testing.assert_array_equal(read, np.nan_to_num(values))


def test_a_normal_map_keeps_its_channels_apart(tmp_path):
    values = np.array([[[1, 2, 3], [4, 5, 6]]], np.float32)
    write_map(tmp_path / "a.bin", values)
    data = (tmp_path / "a.bin").read_bytes()
    assert data == b"2&1&3&" + struct.pack("<6f", 1, 4, 2, 5, 3, 6)


def test_a_graph_byte_by_byte(tmp_path):
    agreeing = np.array([[0, 0b11], [0b10, 0]], np.uint8)
    write_consistency_graph(tmp_path / "a.bin", agreeing, (7, 4))
    data = (tmp_path / "a.bin").read_bytes()
    assert data == b"2&2&1&" + struct.pack("<9i", 1, 0, 2, 7, 4, 0, 1, 1, 4)


def _records(agreeing, image_idxs):
    """Literally as COLMAP's patch match lists them."""
    records = []
    for row, column in np.ndindex(*agreeing.shape):
        confirming = [idx for k, idx in enumerate(image_idxs) if agreeing[row, column] >> k & 1]
        if confirming:
            records += [column, row, len(confirming), *confirming]
    return records


@settings(max_examples=60, deadline=None)
@given(
    agreeing=hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=7)),
    image_idxs=st.lists(st.integers(0, 2**31 - 1), max_size=8),
)
def test_graphs_against_the_loop(agreeing, image_idxs):
    assert consistency_records(agreeing, image_idxs).tolist() == _records(agreeing, image_idxs)


def planted(normal, distance, *, shape=(12, 16), fov=0.6):
    """The map of the plane normal . X = -distance, and the function that knows its depth."""
    height, width = shape
    K = np.array([[width / fov, 0, width / 2], [0, width / fov, height / 2], [0, 0, 1]])
    normal = np.array(normal) / np.linalg.norm(normal)

    def true_depth(K, at):
        rows, columns = np.mgrid[0:height, 0:width] + at
        rays = np.stack([columns, rows, np.ones(shape)], axis=-1) @ np.linalg.inv(K).T
        return -distance / (rays @ normal)

    dense = StereoMap(
        "a.png",
        Camera(K, width, height, np.eye(4)),
        true_depth(K, 0.5).astype(np.float32),
        np.broadcast_to(normal, (*shape, 3)).astype(np.float32),
        np.ones(shape, np.float32),
        (),
        np.zeros(shape, np.uint8),
    )
    return dense, true_depth


@settings(max_examples=60, deadline=None)
@given(x=st.floats(-1, 1), y=st.floats(-1, 1), distance=st.floats(0.01, 1000))
def test_a_plane_stays_where_it_is(x, y, distance):
    dense, true_depth = planted((x, y, -1), distance)
    other = scaled_K(dense.camera, 16, 12) + np.array([[0.2, 0, 0.3], [0, -0.2, -0.1], [0, 0, 0]])
    for K, at in ((dense.camera.K, 0.0), (dense.camera.K, 0.5), (other, 0.0)):
        np.testing.assert_allclose(depth_along(dense, K, at), true_depth(K, at), rtol=1e-5)
    np.testing.assert_array_equal(depth_along(dense, dense.camera.K, 0.5), dense.depth)


def test_a_plane_seen_edge_on_is_left_out_and_one_without_normal_is_kept():
    flat, _ = planted((1, 0, -0.02), 1.0)
    assert np.isnan(depth_along(flat, flat.camera.K, 0.0)).any()
    dense, _ = planted((0, 0, -1), 2.0)
    dense.normal[3, 4] = np.nan
    dense.depth[5, 6] = np.nan
    moved = depth_along(dense, dense.camera.K, 0.0)
    assert moved[3, 4] == pytest.approx(2.0)
    assert np.isnan(moved).sum() == 1
