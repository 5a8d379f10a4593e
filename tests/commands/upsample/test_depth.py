"""``splatseed upsample --method depth``: where maps come from, what is written, what is said."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

from splatseed.io import find_depths, load_scene, write_scene
from splatseed.synthetic import make_capture


def upsample(splatseed, scene, out, *words):
    return splatseed("upsample", scene, "--method", "depth", "-o", out, *words)


@pytest.fixture
def without_points(room, tmp_path):
    """The room as an RGB-D capture in NICE-SLAM's layout: poses and depth, no points."""
    scene = load_scene(room)
    results = tmp_path / "rgbd" / "results"
    results.mkdir(parents=True)
    lines = []
    for i, image in enumerate(scene.images):
        shutil.copy(room / "images" / image.name, results / f"frame{i:06d}.png")
        shutil.copy(room / "depths" / image.name, results / f"depth{i:06d}.png")
        lines.append(" ".join(f"{x:.17g}" for x in image.camera.world_from_cam.ravel()))
    (tmp_path / "rgbd/traj.txt").write_text("\n".join(lines) + "\n")
    K, size = scene.images[0].camera.K, scene.images[0].intrinsics
    camera = {
        "w": size.width,
        "h": size.height,
        "fx": K[0, 0],
        "fy": K[1, 1],
        "cx": K[0, 2],
        "cy": K[1, 2],
        "scale": 5000.0,
    }
    (tmp_path / "rgbd/cam_params.json").write_text(json.dumps({"camera": camera}))
    return tmp_path / "rgbd"


def test_the_maps_are_named_and_noted(room, tmp_path, splatseed):
    run = upsample(splatseed, room, tmp_path / "out", "--depth", room / "depths", "--ratio", 2)
    assert (run.code, run.err) == (0, "")
    written = json.loads((tmp_path / "out/splatseed.json").read_text())
    assert written["depth"] == str((room / "depths").resolve())
    assert written["parameters"]["min_agreeing"] == 2
    for stage in ("read images", "synchronize scales", "compare views", "choose points"):
        assert stage in run.out
    surfaces = make_capture(0, num_views=12, width=120, height=90).surfaces
    seeds = load_scene(tmp_path / "out").points
    new = seeds.xyz[seeds.source != 0].astype(np.float64)
    assert np.median(surfaces.distance(new)) < 0.01


def test_a_capture_has_its_own_maps_and_needs_no_points(without_points, tmp_path, splatseed):
    out = tmp_path / "out"
    run = upsample(splatseed, without_points, out, "--depth.no-align", "--num-points", 700)
    assert (run.code, run.err) == (0, "")
    assert "far from any original" not in run.out
    scene = load_scene(out)
    assert (len(scene.points), len(scene.images)) == (700, 12)
    assert (out / "images" / scene.images[0].name).is_file()
    surfaces = make_capture(0, num_views=12, width=120, height=90).surfaces
    # A PNG holds depth to a tenth of a millimetre.
    assert surfaces.distance(scene.points.xyz.astype(np.float64)).max() < 0.001
    assert "made 700 of its points and kept 0." in splatseed("info", out).out
    for words, says in (
        (["--depth.no-align"], "num_points of 1 or more"),
        (["--num-points", 9], "--poses-from"),
    ):
        run = upsample(splatseed, without_points, tmp_path / "other", *words)
        assert (run.code, run.err.count("\n")) == (2, 1)
        assert says in run.err


def test_the_scenes_own_maps_are_found(room, tmp_path, splatseed):
    clouds = []
    for name, words in (("own", ()), ("named", ("--depth", room / "depths"))):
        run = upsample(splatseed, room, tmp_path / name, "--ratio", 2, *words)
        assert (run.code, run.err) == (0, "")
        clouds.append(load_scene(tmp_path / name).points.xyz)
    np.testing.assert_array_equal(*clouds)
    bare = write_scene(load_scene(room), tmp_path / "bare").path
    (bare / "depths").unlink()
    run = upsample(splatseed, bare, tmp_path / "none")
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert "maps of none of them. Name the folder with the maps: --depth DIR." in run.err


def test_seeds_without_originals_are_never_taken_for_originals(without_points, tmp_path, splatseed):
    seeds = tmp_path / "seeds"
    upsample(splatseed, without_points, seeds, "--depth.no-align", "--num-points", 700)
    run = upsample(splatseed, seeds, tmp_path / "again", "--depth", without_points / "results",
                   "--depth-scale", 5000, "--depth.no-align", "--num-points", 9)  # fmt: skip
    assert run.code == 0, run.err
    assert "None is an original: the 700 points that splatseed added" in run.out
    assert len(load_scene(tmp_path / "again").points) == 9
    for words in (
        ["upsample", seeds, "--method", "mls", "-o", tmp_path / "mls"],
        ["upsample", seeds, "--method", "mls", "--tile-points", 100, "-o", tmp_path / "mls"],
        ["tune", seeds, "-o", tmp_path / "tune"],
        ["bench", "--scenes", seeds, "-o", tmp_path / "bench"],
    ):
        run = splatseed(*words)
        assert (run.code, run.err.count("\n")) == (2, 1), run.err
        assert "found none: it made all 700" in run.err
        assert not words[-1].exists()


@pytest.mark.parametrize(
    "words",
    [("--depth-scale", 5, "--depth.no-align"), ("--depth-kind", "inverse"), ("--ratio", 3000)],
)
def test_maps_that_do_not_fit_are_refused(words, room, tmp_path, splatseed):
    run = upsample(splatseed, room, tmp_path / "out", "--depth", room, *words)
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert not list(tmp_path.iterdir())


def test_the_output_may_not_lie_in_the_maps(own_room, splatseed):
    run = upsample(splatseed, own_room, own_room / "depths/out", "--depth", own_room / "depths")
    assert run.code == 2
    assert not (own_room / "depths/out").exists()


def test_images_left_out_are_told(own_room, tmp_path, splatseed):
    maps = sorted((own_room / "depths").glob("*.png"))
    for path in maps[:3]:
        path.unlink()
    shutil.copy(maps[7], maps[5])  # another image's depth
    run = upsample(splatseed, own_room, tmp_path / "out", "--depth", own_room, "--ratio", 1.5)
    assert run.code == 0
    assert "3 of 12 images have no depth map and give no points." in run.out
    assert f"({maps[5].name}: depth is off by" in run.out


def test_an_upsampled_scene_can_be_upsampled_again(room, tmp_path, splatseed):
    scene = load_scene(room)
    assert set(find_depths(scene, room)) == {image.name for image in scene.images}
    first, second = tmp_path / "first", tmp_path / "second"
    write_scene(scene, first)
    for source, out in ((room, tmp_path / "plain"), (first, second)):
        run = upsample(splatseed, source, out, "--depth", room, "--ratio", 2)
        assert run.code == 0
    again = upsample(splatseed, second, tmp_path / "third", "--depth", room, "--ratio", 2)
    assert again.code == 0
    clouds = [load_scene(tmp_path / name).points.xyz for name in ("plain", "second", "third")]
    np.testing.assert_array_equal(clouds[0], clouds[1])
    np.testing.assert_array_equal(clouds[0], clouds[2])
