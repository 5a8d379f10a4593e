"""``info`` against gsplat: its names, and the lists of its PyTorch code."""

from __future__ import annotations

import copy
import inspect
import pickle
import re
from typing import Any

import gsplat
import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _isect_offset_encode, _isect_tiles
from torch import Tensor

from splatseed.render import rasterization
from splatseed.render.intersections import Grid, intersect

from .scenes import random_scene

LISTS = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")
PER_GAUSSIAN = ("means", "quats", "scales", "opacities", "colors")


def scene_of(cameras: int, count: int = 50) -> dict[str, Any]:
    """Gaussians of which some are culled, over tiles that the image does not fill."""
    scene = random_scene(np.random.default_rng(3), 50, cameras=cameras, size=(75, 41))
    scene["viewmats"][:, 2, 3] = 0.7
    return {**scene, **{name: scene[name][:count] for name in PER_GAUSSIAN}}


def info_of(scene: dict[str, Any], **options: Any) -> Any:
    return rasterization(**scene, **options)[2]


def theirs(info: dict[str, Any]) -> dict[str, Tensor]:
    """gsplat's lists of what is not packed."""
    grid = info["tile_width"], info["tile_height"]
    lists = _isect_tiles(info["means2d"], info["radii"], info["depths"], info["tile_size"], *grid)
    offsets = _isect_offset_encode(lists[1], info["n_cameras"], *grid)
    return dict(zip(LISTS, (*lists, offsets), strict=True))


def assert_same(ours: Tensor, expected: Tensor) -> None:
    assert ours.dtype == expected.dtype
    assert torch.equal(ours, expected)


@pytest.mark.parametrize("cameras", [1, 3])
@pytest.mark.parametrize("tile_size", [16, 7])
@pytest.mark.parametrize("count", [50, 1, 0])
def test_lists_are_gsplats(cameras: int, tile_size: int, count: int) -> None:
    scene = scene_of(cameras, count)
    info = info_of(scene, packed=False, tile_size=tile_size)
    expected = theirs(info)
    assert count < 50 or bool((info["radii"] == 0).any())
    assert count < 50 or len(expected["isect_ids"]) > 100
    for name in LISTS:
        assert_same(info[name], expected[name])


@pytest.mark.parametrize("cameras", [1, 3])
@pytest.mark.parametrize("count", [50, 0])
def test_packed_lists_name_packed_gaussians(cameras: int, count: int) -> None:
    """gsplat's PyTorch code has no packed form: the same pairs, numbered another way."""
    scene = scene_of(cameras, count)
    packed, full = (info_of(scene, packed=packed) for packed in (True, False))
    expected, rows = theirs(full), (packed["camera_ids"], packed["gaussian_ids"])
    assert_same(packed["tiles_per_gauss"], expected["tiles_per_gauss"][rows])
    assert_same(packed["isect_ids"], expected["isect_ids"])
    assert_same(packed["isect_offsets"], expected["isect_offsets"])
    assert packed["flatten_ids"].dtype == torch.int32
    stacked = rows[0] * count + rows[1]
    assert torch.equal(stacked[packed["flatten_ids"].long()].int(), expected["flatten_ids"])


@pytest.mark.parametrize("seed", range(5))
def test_boxes_of_all_sizes_and_places(seed: int) -> None:
    rng = np.random.default_rng(seed)
    means2d = torch.tensor(rng.normal(30, 60, (2, 40, 2)), dtype=torch.float32)
    radii = torch.tensor(rng.integers(0, 50, (2, 40, 2)) // 5 ** rng.integers(0, 3, (2, 40, 1)))
    depths = torch.tensor(rng.uniform(0.01, 100, (2, 40)), dtype=torch.float32)
    grid = Grid(2, *map(int, rng.integers(1, 100, 2)), int(rng.integers(1, 20)))
    expected = _isect_tiles(
        means2d, radii.int(), depths, grid.size, grid.columns, grid.rows
    )  # fmt: skip
    lists = intersect(
        means2d.view(-1, 2), radii.int().view(-1, 2), depths.flatten(),
        torch.arange(2).repeat_interleave(40), grid,
    )  # fmt: skip
    assert_same(lists.tiles_per_gauss, expected[0].flatten())
    assert_same(lists.isect_ids, expected[1])
    assert_same(lists.flatten_ids, expected[2])


def test_equal_depths_stay_in_order() -> None:
    means2d, radii = torch.full((9, 2), 8.0), torch.ones((9, 2), dtype=torch.int32)
    lists = intersect(means2d, radii, torch.ones(9), torch.zeros(9).long(), Grid(1, 16, 16, 16))
    assert lists.flatten_ids.tolist() == list(range(9))


@pytest.mark.parametrize("packed", [True, False])
def test_names_are_gsplats(packed: bool) -> None:
    code = inspect.getsource(gsplat.rasterization)
    info = info_of(scene_of(2), packed=packed)
    assert list(info) == re.findall(r'"(\w+)": ', code)
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


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[None]:
    """Grows by one when lists are made."""
    calls: list[None] = []

    def counted(*given: Any) -> Any:
        calls.append(None)
        return intersect(*given)

    monkeypatch.setattr("splatseed.render.info.intersect", counted)
    return calls


def test_a_step_of_training_makes_no_lists(made: list[None]) -> None:
    scene = scene_of(2)
    means = scene["means"].requires_grad_()
    params, strategy = {"means": means}, gsplat.DefaultStrategy()
    image, _, info = rasterization(**scene, packed=False)
    strategy.step_pre_backward(params, {}, strategy.initialize_state(), 0, info)
    image.sum().backward()
    strategy.step_post_backward(params, {}, strategy.initialize_state(), 0, info)
    assert "isect_ids" in info
    assert "isect" not in info
    assert len(info) == len(list(info)) == len(info.keys())
    assert "made when first read" in repr(info)
    assert info.get("isect") is None
    with pytest.raises(KeyError):
        info["isect"]
    assert not made


@pytest.mark.parametrize(
    "read",
    [
        lambda info: info["flatten_ids"],
        lambda info: info.get("flatten_ids"),
        lambda info: info.get("flatten_ids", 3),
        lambda info: info.setdefault("flatten_ids", 3),
        lambda info: info.pop("flatten_ids"),
        lambda info: dict(info)["flatten_ids"],
        lambda info: {**info}["flatten_ids"],
        lambda info: dict(info.items())["flatten_ids"],
        lambda info: list(info.values())[list(info).index("flatten_ids")],
        lambda info: info.copy()["flatten_ids"],
        lambda info: copy.copy(info)["flatten_ids"],
        lambda info: (info | {"more": 1})["flatten_ids"],
        lambda info: ({"more": 1} | info)["flatten_ids"],
        lambda info: pickle.loads(pickle.dumps(info))["flatten_ids"],  # noqa: S301  (our own bytes)
    ],
)
def test_whatever_hands_out_a_list_makes_it(read: Any, made: list[None]) -> None:
    info = info_of(scene_of(1))
    entry = read(info)
    assert isinstance(entry, Tensor)
    assert torch.equal(entry, info_of(scene_of(1))["flatten_ids"])
    assert len(info.get("isect_ids")) == len(entry)
    assert len(made) == 2


def test_lists_are_made_once_and_may_be_replaced(made: list[None]) -> None:
    info = info_of(scene_of(1))
    info["isect_ids"] = 7
    assert info["tiles_per_gauss"] is info["tiles_per_gauss"]
    assert info["isect_ids"] == 7
    assert len(info["flatten_ids"]) == info["tiles_per_gauss"].sum()
    del info["flatten_ids"]
    assert "flatten_ids" not in info
    assert info.pop("flatten_ids", None) is None
    assert len(made) == 1
