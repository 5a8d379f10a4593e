"""Depth maps in files: the kind that fits the points is found, whatever was assumed or stated."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.depth.alignment import align_maps
from splatseed.depth.kinds import with_fitting_kind
from splatseed.depthmap import HeldDepths
from splatseed.io.load import find_depths
from splatseed.photos.visibility import find_visibility


@pytest.fixture
def written(capture, make_maps, tmp_path):
    """Writes maps of a kind as 16-bit PNGs, and gives the scene with the folder of the maps."""

    def write(kind, noise=0.0, stated=None):
        rng = np.random.default_rng(0)
        for name, depth in make_maps("ray" if kind == "ray" else "z").items():
            z = depth.values * np.exp(noise * rng.normal(size=depth.values.shape))
            low, high = np.nanpercentile(1 / z, [1, 99])
            values = 4000 + 50000 * (1 / z - low) / (high - low) if kind == "inverse" else 3000 * z
            stored = np.nan_to_num(values).clip(0, 65535).astype(np.uint16)
            PilImage.fromarray(stored).save(tmp_path / f"{name.partition('.')[0]}.png")
        if stated:
            (tmp_path / "depths.json").write_text(json.dumps({"kind": stated}))
        return capture.scene.replace(depths=find_depths(capture.scene, tmp_path))

    return write


def chosen(scene):
    scene, findings = with_fitting_kind(scene, find_visibility(scene))
    return scene, scene.depths.read(scene.images[0].name).kind, findings


@pytest.mark.parametrize("noise", [0.0, 0.03])
@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
def test_the_kind_that_fits_is_read(written, kind, noise):
    scene, read, findings = chosen(written(kind, noise if kind != "ray" else 0.0))
    assert read == kind
    assert [each.kind for each in findings] == ([] if kind == "z" else ["depth-kind"])
    assert not any(each.rejected for each in align_maps(scene).values())


@pytest.mark.parametrize(("kind", "stated"), [("inverse", "z"), ("z", "inverse"), ("z", "ray")])
def test_a_stated_kind_is_kept_and_contradicted(written, kind, stated):
    _, read, (finding,) = chosen(written(kind, stated=stated))
    assert read == stated
    assert (finding.kind, finding.severity) == ("depth-kind", "warning")
    assert f"`depth_kind='{kind}'`" in finding.fix
    assert not chosen(written(kind, stated=kind))[2]


def test_the_unit_of_a_captures_own_maps_is_named(written):
    """16-bit maps of 3,000 units are read as millimetres: a third of the scene's unit."""
    scene = written("z")
    assert not chosen(scene)[2]  # a network's maps have no unit
    own = scene.replace(depths=replace(scene.depths, in_scene_units=True))
    (finding,) = chosen(own)[2]
    assert (finding.kind, finding.severity) == ("depth-unit-mismatch", "info")
    assert float(finding.text.partition("by ")[2].split(",")[0]) == pytest.approx(1 / 3, rel=0.01)
    right = scene.replace(depths=replace(own.depths, scale=3000.0))
    assert not chosen(right)[2]


def test_maps_that_fit_no_kind_are_left_as_they_are(written, rng):
    scene = written("z")
    for path in scene.depths.paths.values():
        stored = rng.integers(1000, 60000, (120, 160)).astype(np.uint16)
        PilImage.fromarray(stored).save(path)
    assert chosen(scene)[1:] == ("z", [])


def test_maps_in_memory_and_a_scene_without_points_say_nothing(written, make_maps):
    scene = written("inverse")
    held = scene.replace(depths=HeldDepths(make_maps("ray")))
    assert chosen(held)[1:] == ("ray", [])
    bare = scene.replace(points=scene.points.select(np.zeros(len(scene.points), bool)))
    assert chosen(bare)[1:] == ("z", [])
