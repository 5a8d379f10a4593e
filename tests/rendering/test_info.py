"""``info`` against gsplat: its names, and the lists of its PyTorch code."""

from __future__ import annotations

import inspect
import re

import gsplat
import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _isect_offset_encode, _isect_tiles

from splatseed.rendering import rasterization
from splatseed.rendering.rasterize import LISTS

from .scenes import PER_GAUSSIAN, random_scene


def scene_of(cameras, count=50):
    """Gaussians of which some are culled, over tiles that the image does not fill."""
    scene = random_scene(np.random.default_rng(3), 50, cameras=cameras, size=(75, 41))
    scene["viewmats"][:, 2, 3] = 0.7
    return {**scene, **{name: scene[name][:count] for name in PER_GAUSSIAN}}


def theirs(info):
    """gsplat's lists of what is not packed."""
    grid = info["tile_width"], info["tile_height"]
    lists = _isect_tiles(info["means2d"], info["radii"], info["depths"], info["tile_size"], *grid)
    offsets = _isect_offset_encode(lists[1], info["n_cameras"], *grid)
    return dict(zip(LISTS, (*lists, offsets), strict=True))


def assert_same(ours, expected):
    assert ours.dtype == expected.dtype
    assert torch.equal(ours, expected)


@pytest.mark.parametrize(("cameras", "tile_size", "count"), [(1, 16, 50), (3, 7, 50), (3, 16, 0)])
def test_lists_are_gsplats(cameras, tile_size, count):
    scene = scene_of(cameras, count)
    info, packed = (
        rasterization(**scene, packed=each, tile_size=tile_size)[2] for each in (False, True)
    )
    expected = theirs(info)
    assert count < 50 or bool((info["radii"] == 0).any())
    assert count < 50 or len(expected["isect_ids"]) > 100
    for name in LISTS:
        assert_same(info[name], expected[name])
    # gsplat's PyTorch code has no packed form: the same pairs, numbered another way.
    rows = packed["camera_ids"], packed["gaussian_ids"]
    assert_same(packed["tiles_per_gauss"], expected["tiles_per_gauss"][rows])
    assert_same(packed["isect_ids"], expected["isect_ids"])
    assert_same(packed["isect_offsets"], expected["isect_offsets"])
    stacked = (rows[0] * count + rows[1]).int()
    assert_same(stacked[packed["flatten_ids"].long()], expected["flatten_ids"])
    assert packed["flatten_ids"].dtype == torch.int32


@pytest.mark.parametrize("packed", [True, False])
def test_names_are_gsplats(packed):
    code = inspect.getsource(gsplat.rasterization)
    info = rasterization(**scene_of(2), packed=packed)[2]
    assert {*info, *LISTS} == set(re.findall(r'"(\w+)": ', code))
    assert [info[name] for name in ("n_batches", "n_cameras", "tile_size")] == [1, 2, 16]
    assert (info["tile_width"], info["tile_height"]) == (5, 3)
    assert info["isect_offsets"].shape == (2, 3, 5)
    assert info["tiles_per_gauss"].shape == info["depths"].shape
    for name in ("batch_ids", "camera_ids", "gaussian_ids"):
        if packed:
            assert (info[name].dtype, len(info[name])) == (torch.int64, len(info["depths"]))
        else:
            assert info[name] is None
    assert not packed or not info["batch_ids"].any()


def test_a_training_step_computes_no_lists():
    scene = scene_of(2)
    means = scene["means"].requires_grad_()
    params, strategy = {"means": means}, gsplat.DefaultStrategy()
    image, _, info = rasterization(**scene, packed=False)
    strategy.step_pre_backward(params, {}, strategy.initialize_state(), 0, info)
    image.sum().backward()
    strategy.step_post_backward(params, {}, strategy.initialize_state(), 0, info)
    assert not set(LISTS) & set(info)
    assert info["isect_ids"] is info["isect_ids"]  # made once
    with pytest.raises(KeyError):
        info["isect"]
