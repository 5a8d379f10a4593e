"""Mistakes of callers from Python: one of our errors, which names the argument, or a note."""

from __future__ import annotations

import numpy as np
import pytest

import splatseed as ss
from splatseed.errors import ParameterError, UnknownNameError

POINT = np.zeros((1, 3)), np.zeros((1, 3), np.uint8)


@pytest.mark.parametrize(
    ("call", "error", "named"),
    [
        (lambda _: ss.upsample("room"), ParameterError, "load_scene"),
        (lambda room: ss.upsample(room, "msl"), UnknownNameError, "Did you mean mls"),
        (lambda room: ss.upsample(room, "mls", kk=3), ParameterError, "'kk'"),
        (lambda room: ss.stereo_depths(room, gird=2), ParameterError, "Did you mean grid"),
        (lambda room: room.with_depths({"v.png": np.ones((2, 2))}), UnknownNameError, "v.png"),
    ],
)
def test_a_wrong_argument_is_named(call, error, named, room):
    with pytest.raises(error, match=named):
        call(room)


def test_what_cannot_be_rendered_is_named(room):
    pytest.importorskip("torch", reason="rendering needs PyTorch")
    from splatseed.splat.from_seeds import initial_gaussians

    gaussians, image = initial_gaussians(room.points), room.images[0]
    for arguments, named in (
        ({"gaussians": room, "camera": image}, "gaussians"),
        ({"gaussians": gaussians, "camera": "view_001.png"}, "camera"),
        ({"gaussians": gaussians, "camera": image, "backend": "gpu"}, "backend"),
    ):
        with pytest.raises(ParameterError, match=named):
            ss.render(**arguments)


def test_points_of_ones_own_are_counted_where_upsampling_leaves_them_out(room):
    notes = []
    own = room.with_points(room.points.with_added(*POINT))
    seeds = ss.upsample(own, "mls", ratio=2, note=notes.append)
    assert len(seeds) == 2 * len(room.points)
    assert len(notes) == 1
    assert notes[0].text.startswith("1 point")
    ss.upsample(room, "mls", ratio=2, note=notes.append)
    assert len(notes) == 1


def test_methods_and_maps_are_short_to_show(room):
    assert repr(ss.METHODS).startswith("METHODS(linear, ")
    smaller = room.replace(images=room.images[:3])
    assert len(repr(ss.stereo_depths(smaller)[0])) < 80
