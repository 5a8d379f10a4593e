"""Lifted points against surfaces that are known, the text and the settings; what is refused."""

from __future__ import annotations

import dataclasses
import re
import shutil

import numpy as np
import pytest
from PIL import Image as PilImage

import splatseed as ss
from splatseed.camera import Intrinsics
from splatseed.depth import lifting
from splatseed.depth.alignment import PlanarDepth, lift_pixels
from splatseed.depth.settings import PER_POINT
from splatseed.depthmap import HeldDepths
from splatseed.errors import ParameterError, PointCloudError, SceneFormatError, SceneNotFoundError
from splatseed.scene import SceneSource, Split

FLOAT32 = 3e-6  # metres, in a room of 5


def lifted(scene, num, profile="default", **changes):
    """Only the new points."""
    seeds = ss.upsample(
        scene, "depth", num_points=len(scene.points) + num, profile=profile, **changes
    )
    assert len(seeds) == len(scene.points) + num
    assert set(seeds.source[len(scene.points) :]) == {6}
    return seeds.select(slice(len(scene.points), None))


@pytest.mark.parametrize("kind", ["z", "ray", "inverse"])
def test_lifted_points_lie_on_the_surfaces(kind, exact, capture, make_maps):
    change = (lambda z, _: 1 / z) if kind == "inverse" else (lambda z, _: z)
    scene = exact.replace(depths=make_maps(kind, change))
    new = lifted(scene, 5000, align=False)
    assert capture.surfaces.distance(new.xyz.astype(np.float64)).max() < FLOAT32
    aligned = lifted(scene, 5000)  # SfM points are off by millimetres
    assert np.median(capture.surfaces.distance(aligned.xyz.astype(np.float64))) < 0.002


def test_equation_9_equals_a_loop_over_pixels(exact, rng):
    image = exact.images[0]
    camera, depth = image.camera, exact.depths.read(image.name)
    pixel = rng.choice(np.flatnonzero(depth.values > 0), 50, replace=False)
    scale = 1.7
    for unit_ray in (False, True):
        planar = PlanarDepth.from_map(depth, camera, scale, 0.0, unit_ray=unit_ray)
        lifted = lift_pixels(pixel, planar.at_pixels(pixel), camera)
        for number, point in zip(pixel.tolist(), lifted, strict=True):
            v, u = number // 160 + 0.5, number % 160 + 0.5
            ray = camera.cam_from_world[:3, :3].T @ np.linalg.inv(camera.K) @ [u, v, 1.0]
            if unit_ray:
                ray /= np.sqrt(sum(x * x for x in ray))
            d = float(depth.values[number // 160, number % 160])
            np.testing.assert_allclose(point, camera.center + scale * d * ray, atol=FLOAT32)


def test_colors_are_those_of_the_pixels(exact, capture):
    new = lifted(exact, 4000, align=False)
    seen = np.zeros(4000, bool)
    for image, pixels in zip(exact.images, capture.images, strict=True):
        uv, z = image.camera.project(new.xyz)
        inside = (z > 0) & ((uv >= 0) & (uv < (160, 120))).all(axis=1)
        column, row = np.floor(uv[inside]).astype(int).T
        centred = np.abs(uv[inside] - np.floor(uv[inside]) - 0.5).max(axis=1) < 1e-3
        same = (pixels[row, column] == new.rgb[inside]).all(axis=1)
        seen[np.flatnonzero(inside)[centred & same]] = True
    assert seen.all()  # each is the centre of a pixel of its colour in some image


def test_the_paper_profile_takes_equal_numbers_from_the_middle_of_each_image(exact):
    new = lifted(exact, 1203, "paper", unit_ray=False, align=False)
    middle = np.zeros(12, int)
    for i, (image, part) in enumerate(zip(exact.images, np.array_split(new.xyz, 12), strict=True)):
        uv, _ = image.camera.project(part)  # points come image after image
        middle[i] = ((uv > (40, 30)) & (uv < (120, 90))).all(axis=1).sum()
    assert sorted(middle) == [100] * 9 + [101] * 3


@pytest.mark.parametrize("profile", ["default", "paper"])
def test_bytes_depend_on_the_seed_and_not_on_threads(profile, exact, set_threads):
    results = []
    for threads in (1, 7):
        set_threads(threads)
        new = lifted(exact, 3000, profile, seed=3)
        results.append(new.xyz.tobytes() + new.rgb.tobytes())
    assert results[0] == results[1]
    assert lifted(exact, 3000, profile, seed=4).xyz.tobytes() not in results[0]


def test_test_images_are_not_read(exact):
    class Watched(dict):
        def read(self, name):
            names.add(name)
            return self[name]

    names = set()
    scene = exact.replace(depths=Watched(exact.depths))
    lifted(scene, 200, test_every=8)
    test_names = {image.name for image in scene.split(8)[1]}
    used = {image.name for image in scene.images} - test_names
    assert names == used
    names.clear()
    lifted(scene.replace(listed=Split(frozenset(used), frozenset(test_names), "list")), 200)
    assert names == used


def test_images_are_read_again_if_too_few_candidates_are_sound(exact, make_maps, monkeypatch):
    """Each map is off by its own tenth, unaligned: hardly a candidate is confirmed."""
    reads, plain = [], lifting.read_view

    def counted(*args):
        reads.append(args[4])
        return plain(*args)

    monkeypatch.setattr(lifting, "read_view", counted)
    scale = 1 + 0.06 * np.sin(np.arange(12) * 2.0)
    scene = exact.replace(depths=make_maps("z", lambda z, i: z * scale[i]))
    notes = []
    lifted(scene, 3000, align=False, note=notes.append)
    assert len(set(reads)) > 1
    assert max(reads) <= lifting.OVERSAMPLING.limit * 3000 / 12 + 1
    assert any(re.match(r"[\d,]+ of 3,000 ", note.text) for note in notes)


def test_all_pixels_can_be_lifted_but_no_more(exact):
    scene = exact.replace(images=exact.images[:2])
    pixels = sum(int((exact.depths.read(im.name).values > 0).sum()) for im in scene.images)
    options = {"min_agreeing": 0, "see_through": True, "edge_tolerance": None}
    new = lifted(scene, pixels, **options)
    assert len(np.unique(new.xyz, axis=0)) == pixels
    for profile, change in (("default", options), ("paper", {"central_fraction": 1.0})):
        with pytest.raises(PointCloudError, match=rf"{pixels + 1:,}.*{pixels:,}"):
            lifted(scene, pixels + 1, profile, **change)


def test_metric_depth_needs_no_points(exact, capture):
    empty = exact.replace(points=exact.points.select(slice(0)), tracks=None)
    seeds = ss.upsample(empty, "depth", num_points=1500, align=False)
    assert len(seeds) == 1500
    assert capture.surfaces.distance(seeds.xyz.astype(np.float64)).max() < FLOAT32
    with pytest.raises(ParameterError, match="num_points"):
        ss.upsample(empty, "depth", ratio=4, align=False)
    for num in (None, 1500):
        with pytest.raises(PointCloudError, match=r"found none.*`depth\.align=False`"):
            ss.upsample(empty, "depth", num_points=num)


@pytest.fixture
def metric(make_maps):
    """Makes maps that come with a capture, in its unit."""

    class MetricMaps(HeldDepths):
        in_scene_units = True

    return lambda *arguments: MetricMaps(make_maps(*arguments))


def test_a_capture_with_metric_depth_needs_no_option(exact, capture, metric):
    empty = exact.replace(points=exact.points.select(slice(0)), tracks=None, depths=metric())
    seeds = ss.upsample(empty, "depth")
    assert len(seeds) == round(0.25 * 160 * 120)
    assert capture.surfaces.distance(seeds.xyz.astype(np.float64)).max() < FLOAT32
    first = empty.replace(images=empty.images[:1])
    known = int((first.depths.read(first.images[0].name).values > 0).sum())
    assert len(ss.upsample(first, "depth", see_through=True)) == known // PER_POINT


@pytest.mark.parametrize("wrong", ["feet", "millimetres", "kilometres", "axes"])
def test_metric_maps_that_contradict_each_other_are_refused(exact, metric, wrong):
    """Without points nothing else would show that their unit or the poses are wrong."""
    scale = {"feet": 3.28, "millimetres": 1000, "kilometres": 0.001, "axes": 1}[wrong]
    bare = exact.replace(points=exact.points.select(slice(0)), tracks=None)
    bare = bare.replace(depths=metric("z", lambda z, _: scale * z))
    if wrong == "axes":
        posed = [  # half a turn about x: OpenGL's camera axes
            dataclasses.replace(
                image,
                quat=image.quat[[1, 0, 3, 2]] * [-1, 1, -1, 1],
                translation=image.translation * [1, -1, -1],
            )
            for image in bare.images
        ]
        bare = bare.replace(images=tuple(posed))
    with pytest.raises(SceneFormatError, match=r"agree with each other.*`depth\.min_agreeing=0`"):
        ss.upsample(bare, "depth", num_points=1500)
    assert (
        len(ss.upsample(bare, "depth", num_points=1500, min_agreeing=0, see_through=True)) == 1500
    )


def test_images_with_few_points_keep_metric_depth(exact, capture, metric):
    """Of an image before a bare wall; without a unit, it is left out."""
    few = exact.with_points(exact.points.select(slice(60)))
    notes = []
    new = lifted(few.replace(depths=metric()), 4000, note=notes.append, min_points=30)
    assert not notes
    assert np.median(capture.surfaces.distance(new.xyz.astype(np.float64))) < 0.002
    # Where points show that the unit is another one, it is no help.
    other = metric("z", lambda z, _: 3 * z)
    lifted(few.replace(depths=other), 1000, note=notes.append, min_points=30)
    lifted(few, 1000, note=notes.append, min_points=30)
    left_out = [note.text for note in notes if note.kind == "unfit-depth-maps"]
    assert len(left_out) == 2
    assert all(text.startswith("10 of 12 depth maps are left out") for text in left_out)
    assert "SfM points on known depth; 30 are needed" in left_out[1]


def test_depth_of_low_confidence_is_not_lifted(exact, capture, make_maps):
    sure = np.full((120, 160), 2, np.uint8)
    sure[:, 120:] = 0

    def change(z, _):
        z[:, 120:] *= 1.3
        return z

    wrong = make_maps("z", change)
    maps = {name: dataclasses.replace(each, confidence=sure) for name, each in wrong.items()}
    scene, off = exact.replace(depths=maps), capture.surfaces.distance
    options = {"align": False, "min_agreeing": 0, "see_through": True}
    assert off(lifted(scene, 2000, **options).xyz.astype(np.float64)).max() < FLOAT32
    assert off(lifted(scene, 2000, min_confidence=0, **options).xyz.astype(np.float64)).max() > 0.1


def test_infinities_zeros_and_negatives_are_never_lifted(exact, make_maps):
    def change(z, i):
        z[::3] = (np.inf, 0.0, -1.0)[i % 3]
        return z

    for profile in ("default", "paper"):
        scene = exact.replace(depths=make_maps("z", change))
        seeds = ss.upsample(scene, "depth", ratio=2, profile=profile)
        assert seeds.finite.all()
        assert np.abs(seeds.xyz).max() < 10


# What is refused ----------------------------------------------------------------------------------


@pytest.fixture
def own(exact, tmp_path):
    """The scene with a folder of photographs that a test may spoil."""
    folder = shutil.copytree(exact.source.image_dir, tmp_path / "images")
    return exact.replace(source=dataclasses.replace(exact.source, image_dir=folder))


def test_scenes_that_cannot_be_lifted_are_refused(own, make_maps):
    photograph = own.source.image_dir / "view_004.png"
    focal, _, cx, cy = own.images[0].intrinsics.params

    def with_bend(k):
        lens = Intrinsics(1, "SIMPLE_RADIAL", 160, 120, (focal, cx, cy, k))
        return own.replace(
            images=tuple(dataclasses.replace(image, intrinsics=lens) for image in own.images)
        )

    large = own.replace(depths=make_maps("z", lambda z, _: 1000 * z))
    for scene, write, error, said in (
        (own.points, None, SceneNotFoundError, "`depth`"),
        (own.replace(depths=None), None, SceneNotFoundError, "`depth`"),
        (own.replace(images=()), None, SceneNotFoundError, "`depth`"),
        (own.replace(source=SceneSource()), None, SceneNotFoundError, "photographs"),
        (with_bend(0.1), None, SceneFormatError, "SIMPLE_RADIAL for view_000"),
        (own, lambda: photograph.write_bytes(b"no image"), SceneFormatError, "view_004.png"),
        (own, lambda: resized(photograph, (120, 160)), SceneFormatError, "120 x 160"),
        (large, lambda: resized(photograph, (320, 240)), SceneFormatError, "`depth_scale`"),
    ):
        if write is not None:
            write()
        with pytest.raises(error, match=said):
            ss.upsample(scene, "depth", ratio=2, align=scene is not large)
    # Another size does no harm, nor a lens that could bend but does not.
    assert ss.upsample(with_bend(0.0), "depth", ratio=2).finite.all()
    aligned, plain = (ss.upsample(scene, "depth", ratio=2) for scene in (large, own))
    assert np.median(np.linalg.norm(aligned.xyz - plain.xyz, axis=1)) < 0.01


def resized(path, size):
    path.unlink()
    with PilImage.open(path.with_name("view_003.png")) as picture:
        picture.resize(size).save(path)
