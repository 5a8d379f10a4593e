"""``splatseed info``: every kind of scene, its depth maps, its poses, and what it advises."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed import upsample
from splatseed.checkup.pose_accuracy import PoseErrorEstimate
from splatseed.commands import next_steps
from splatseed.commands.next_steps import number_option
from splatseed.depth.alignment import align_maps
from splatseed.depth.settings import PER_POINT
from splatseed.io import find_depths, load_scene, write_scene
from splatseed.io.colmap import write_points3d
from splatseed.io.depth_maps import depth_folder
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud
from splatseed.splat.formats import write_gaussians
from splatseed.splat.gaussians import Gaussians


def _pairs(out):
    """Label to value, from the tables."""
    lines = [line.strip().split("  ", 1) for line in out.splitlines()]
    return {line[0]: line[1].strip() for line in lines if len(line) == 2}


def test_a_colmap_scene(room, splatseed, monkeypatch):
    monkeypatch.setattr(next_steps, "which", lambda _: None)  # as without a GPU
    run = splatseed("info", room)
    assert (run.code, run.unexpected) == (0, "")
    scene, rows = load_scene(room), _pairs(run.out)
    assert rows["format"] == "colmap"
    assert rows["cameras"] == "1 PINHOLE 96x72"
    assert rows["images"] == "12 (10 to train, 2 to test)"
    assert rows["few photographs"].startswith("method auto gives every second pixel a seed")
    assert rows["points"] == f"{len(scene.points):,}"
    assert rows["depth maps"].startswith("12 beside the photographs; method depth aligns")
    assert rows["track length, images"].startswith(f"mean {scene.tracks.lengths.mean():.3g},")
    assert rows["reprojection error, px"].startswith(f"mean {scene.tracks.errors.mean():.3f},")
    low = [float(x) for x in rows["bounding box"].split()[:3]]
    np.testing.assert_allclose(low, scene.points.xyz.min(axis=0), rtol=1e-3)
    advised = run.out.partition("\nnext\n")[2]
    assert re.findall(r"splatseed (\w+)", advised) == ["train", "upsample"]  # 10 get 1,500 steps
    assert rows["photographs agree"].endswith("of the pixels compared: enough")


def test_sizes_are_those_of_the_files(room, tmp_path, splatseed):
    own = shutil.copytree(room, tmp_path / "own", symlinks=False)
    for path in (own / "images").iterdir():
        PilImage.open(path).resize((48, 36)).save(path)
    rows, facts = _pairs(splatseed("info", own).out), splatseed("info", own, "--json").out
    assert rows["cameras"] == "1 PINHOLE 48x36"
    assert rows["photographs agree"].endswith("of the pixels compared: enough")
    assert [(c["width"], c["height"]) for c in json.loads(facts)["cameras"]] == [(48, 36)]


@pytest.mark.parametrize("name", ["model.ply", "model.spz", "model.splat", "model.sog"])
def test_trained_gaussians(name, rng, splatseed, tmp_path):
    count, path = 500, tmp_path / name
    opacities = np.where(np.arange(count) % 5 == 0, -4.0, 3.0)
    arrays = {
        "means": rng.uniform([-1, -2, 3], [1, 2, 9], (count, 3)),
        "scales": np.log(np.tile([0.02, 0.5, 0.25], (count, 1))),
        "quats": rng.normal(size=(count, 4)),
        "opacities": opacities,
        "sh0": rng.normal(size=(count, 1, 3)),
        "shN": 0.1 * rng.normal(size=(count, 8, 3)),
    }
    write_gaussians(path, Gaussians(**{k: a.astype(np.float32) for k, a in arrays.items()}))
    run = splatseed("info", path)
    assert (run.code, run.unexpected) == (0, "")
    rows, facts = _pairs(run.out), json.loads(splatseed("info", path, "--json").out)
    assert (rows["Gaussians"], facts["gaussians"]) == ("500", 500)
    assert facts["sh_degree"] == (0 if name.endswith(".splat") else 2)
    assert rows["fainter than 0.1"] == "20%"
    assert facts["flat"] == 1.0
    np.testing.assert_allclose(facts["opacity"], [0.018, 0.953, 0.953, 0.953, 0.953], atol=0.02)
    np.testing.assert_allclose(facts["size"], 5 * [0.5], rtol=0.06)
    expected = [arrays["means"].min(axis=0), arrays["means"].max(axis=0)]
    np.testing.assert_allclose(facts["bounding_box"], expected, atol=0.02)
    assert f"splatseed view {path}" in run.out
    assert splatseed("info", path, "--budget", 9).code == 2


def test_the_advice_depends_on_the_plan(room, splatseed):
    full = splatseed("info", room, "--budget", 60, "--max-steps", 500).out
    assert "there is no room for more" in full
    assert "--seeds scene --budget 60 --max-steps 500" in full.partition("\nnext\n")[2]
    sparse = splatseed("info", room, "--budget", 3456, "--max-steps", 20000).out
    assert "add points by method auto" in sparse
    assert "No point falls in 75% of the cells" in " ".join(sparse.split())
    assert "--seeds" not in sparse  # train follows the same rule
    assert "--budget 3456 --max-steps 20000" in sparse
    assert "3,456 Gaussians at most (0.5rho of 96 x 72 pixels), 20,000 steps" in sparse


def test_info_on_points_alone_does_not_wait_for_numba(room):
    code = "import sys; from splatseed.cli import main; main(sys.argv[1:]); print(*sys.modules)"
    words = [sys.executable, "-c", code, "info", str(room / "sparse" / "0" / "points3D.ply")]
    run = subprocess.run(words, capture_output=True, check=False, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    assert not {"numba", "torch"} & set(run.stdout.splitlines()[-1].split())


def test_a_single_photograph_cannot_be_compared(room, tmp_path, splatseed):
    scene = load_scene(room)
    alone = scene.replace(images=scene.images[:1], points=PointCloud.empty(), tracks=None)
    write_scene(alone, tmp_path / "alone", require_points=False)
    run = splatseed("info", tmp_path / "alone")
    assert run.code == 0
    assert "cannot be compared" in run.out


@pytest.mark.parametrize(
    ("xyz", "points", "finite"),
    [(np.zeros((0, 3)), "none", True), (np.full((4, 3), np.nan), "4", False)],
)
def test_empty_and_unusable_clouds(xyz, points, finite, tmp_path, splatseed):
    write_ply(tmp_path / "cloud.ply", PointCloud(xyz, np.zeros(xyz.shape, np.uint8)))
    run = splatseed("info", tmp_path / "cloud.ply")
    assert run.code == 0
    assert _pairs(run.out)["points"] == points
    assert ("not finite" in run.out) != finite
    assert "nan" not in run.out


def test_points_of_another_model_are_a_problem(own_room, room, splatseed):
    write_points3d(own_room / "sparse/0/points3D.bin", load_scene(room).points, None)
    out = splatseed("info", own_room).out
    assert _pairs(out)["tracks"] == "none"
    assert "no point has a track" in out
    assert "nan" not in out
    assert (
        splatseed("upsample", own_room, "--method", "mls", "-o", own_room.with_name("up")).code == 0
    )
    assert "no point has a track" not in splatseed("info", own_room.with_name("up")).out


# Depth maps ---------------------------------------------------------------------------------------


ROW = re.compile(r"^(\S+\.\w+) +([\d,]+) +(\S+)(?: +(\S+))? +(\S+%|-)$", re.MULTILINE)


def _rows(out):
    """The images that are listed, and their columns."""
    return {row[0]: row[1:] for row in ROW.findall(out)}


@pytest.fixture(scope="session")
def tour(room_of):
    """A room of 15 views: more than are listed. Not to be written to."""
    return room_of(15, 64, 48).path


def test_maps_that_do_not_fit_are_not_advised(room, splatseed):
    run = splatseed("info", room, "--depth", room / "depths", "--depth-kind", "inverse")
    assert "12 of 12 depth maps" in run.out
    assert "--method depth" not in run.out
    assert "by method depth" not in run.out
    assert _pairs(run.out)["depth maps"] == "12 of 96 x 72 pixels"


def test_true_depth_fits(room, splatseed):
    run = splatseed("info", room, "--depth", room / "depths")
    assert (run.code, run.unexpected) == (0, "")
    pairs, rows = _pairs(run.out), _rows(run.out)
    assert pairs["maps"] == "12 of 12 images, the first 96 x 72, kind z"
    assert pairs["left out"] == "0"
    scene = load_scene(room)
    expected = align_maps(scene.replace(depths=find_depths(scene, room / "depths")))
    assert rows.keys() == expected.keys()
    for name, (points, scale, _, residual) in rows.items():
        assert int(points.replace(",", "")) == expected[name].num_points
        assert float(scale) == pytest.approx(expected[name].scale, rel=1e-3)
        assert float(scale) == pytest.approx(1, abs=0.02)
        assert float(residual.rstrip("%")) == pytest.approx(100 * expected[name].residual, abs=0.01)
    assert f"--method depth --depth {room / 'depths'}" in run.out.splitlines()[-1]


def test_the_worst_are_listed_first_and_the_rest_on_demand(tour, tmp_path, splatseed):
    depths, maps = find_depths(load_scene(tour), tour / "depths"), tmp_path / "maps"
    names, rng = sorted(depths)[:14], np.random.default_rng(4)
    with depth_folder(maps, "z") as writer:
        for i, name in enumerate(names):
            z = np.array(depths.read(name).values, np.float32)
            if i in {2, 4}:  # nothing in one, much that is wrong in the other
                z[rng.random(z.shape) < {2: 1.0, 4: 0.2}[i]] *= {2: np.nan, 4: 1.3}[i]
            writer.write(name, z)
    out = splatseed("info", tour, "--depth", maps, "--picture", tmp_path / "a.png").out
    pairs, rows = _pairs(out), _rows(out)
    assert pairs["maps"].startswith("14 of 15 images")
    assert pairs["left out"] == "1"
    assert "the 12 worst; --json has all" in out
    assert list(rows)[:2] == [names[2], names[4]]
    assert (len(rows), rows[names[2]]) == (12, ("0", "-", "", "-"))
    assert f"- {names[2]}: " in out
    assert "- 1 of 14 depth maps" in out.partition("problems")[2]
    assert len(json.loads(splatseed("info", tour, "--depth", maps, "--json").out)["depth"]) == 14
    with PilImage.open(tmp_path / "a.png") as picture:
        assert np.ptp(np.asarray(picture), axis=2).max() > 50


@pytest.mark.parametrize(
    ("points", "known", "most", "said"),
    [
        (100, 10**6, 10**6, "--ratio 16"),
        (100, 10**6, 900, "--num-points 900"),  # training would thin out the others
        (100, 80, 900, "--num-points 110"),
        (100, 10**6, 50, "--num-points 101"),
        (0, 800, 10**6, "--num-points 100"),
    ],
)
def test_the_number_of_points_suggested(points, known, most, said):
    assert number_option(points, known, most) == said


def test_a_scenes_own_maps_are_described_and_can_be_lifted(rgbd, tmp_path, splatseed):
    run = splatseed("info", rgbd)
    assert run.code == 0
    assert _pairs(run.out)["depth maps"] == "12 of 96 x 72 pixels; method auto uses them"
    for text in ("left out", "to align the depth maps with", "no-align", "confidence"):
        assert text not in run.out
    lifted, triangulated = run.out.splitlines()[-2:]
    assert "splatseed sfm" in triangulated
    assert "--depth" not in lifted
    words = shlex.split(lifted.split("splatseed ")[1])
    made = splatseed(*[tmp_path / "out" if word == "OUT" else word for word in words])
    assert made.code == 0, made.err
    assert len(load_scene(tmp_path / "out").points) == round(0.25 * 96 * 72)


def test_maps_in_another_unit_are_a_problem(rgbd, splatseed):
    camera = rgbd / "cam_params.json"
    camera.write_text(camera.read_text().replace('"scale": 5000', '"scale": 1000'))
    run = splatseed("info", rgbd)
    assert run.code == 0
    assert _pairs(run.out)["depth maps"] == "12 of 96 x 72 pixels"
    assert "the depth maps are in another unit than the poses: their depth is" in run.out
    assert "--method depth" not in run.out


def test_maps_of_low_confidence_do_not_count(rgbd, tmp_path, splatseed):
    """Of a tenth of their pixels depth is used, and an eighth of these give a point."""
    for path in (rgbd / "results").glob("depth*.png"):
        levels = np.zeros((72, 96), np.uint8)
        levels[:18, :40] = 2
        PilImage.fromarray(levels).save(path.with_name(path.name.replace("depth", "conf")))
    out = splatseed("info", rgbd).out
    assert "of high confidence at 10%, medium 0%, low 90%" in _pairs(out)["depth maps"]
    out = splatseed("upsample", rgbd, "--method", "depth", "-o", tmp_path / "out").err
    assert f"{12 * 18 * 40 // PER_POINT:,} points" in out


# What splatseed wrote -----------------------------------------------------------------------------


def test_a_seeded_scene_is_advised_for_training(room, tmp_path, splatseed):
    scene, path = load_scene(room), tmp_path / "my seeds"
    far = scene.points.xyz.copy()
    far[:40] += 100 * np.arange(1, 41)[:, None]
    scene = scene.replace(points=scene.points.replace(xyz=far), tracks=None)
    write_scene(scene, tmp_path / "plain", provenance={})
    plain = splatseed("info", tmp_path / "plain").out
    assert "are isolated" in plain
    seeds = upsample(scene, "linear", ratio=4)
    write_scene(scene.replace(points=seeds), path, provenance={"command": "upsample"})
    run = splatseed("info", path)
    assert (run.code, run.unexpected) == (0, "")
    assert "are isolated" not in run.out
    assert _pairs(run.out)["isolated"] == _pairs(plain)["isolated"]
    assert re.search(rf"{len(seeds) - len(far):,} .* {len(far)}", run.out)
    assert f"splatseed train '{path}' -o RUN\n" in run.out
    assert "upsampl" not in run.out.replace("splatseed upsample made", "")


# Poses --------------------------------------------------------------------------------------------


def test_exact_poses_without_points_are_advised_to_get_points(
    room, tmp_path, splatseed, monkeypatch
):
    scene = load_scene(room).replace(points=PointCloud.empty(), tracks=None, depths=None)
    write_scene(scene, tmp_path / "nerf", format="transforms", require_points=False)
    run = splatseed("info", tmp_path / "nerf")
    assert run.code == 0
    rows, advised = _pairs(run.out), run.out.partition("next")[2]
    assert rows["points"] == "none"
    assert rows["photographs agree"].startswith("at ")
    assert "there are no points" in run.out
    assert "splatseed upsample" in advised
    assert f"--poses-from {tmp_path / 'nerf'}" in advised
    assert "--refine-poses" not in advised
    assert "nan" not in run.out
    monkeypatch.setattr("splatseed.checkup.poses.check_poses", lambda *_: 0.08)
    problems = json.loads(splatseed("info", tmp_path / "nerf", "--json").out)["problems"]
    assert sum("agree on the depth of only 8%" in each for each in problems) == 1


def test_poses_are_measured_by_training_views_unless_these_give_no_estimate(
    room_of, as_by_a_device, tmp_path, splatseed, monkeypatch
):
    scene = as_by_a_device(load_scene(room_of(16, 160, 120).path), degrees=1.0)
    path = write_scene(scene, tmp_path / "bare", require_points=False).path
    measured, train = [], scene.split()[0]

    def estimate(_, images, *__):
        measured.append([image.name for image in images])
        return None if len(measured) == 1 else PoseErrorEstimate(0.7, 0.1, False, 160)

    monkeypatch.setattr("splatseed.checkup.pose_accuracy.estimate_pose_error", estimate)
    error = json.loads(splatseed("info", path, "--json").out)["poses"]["error"]
    assert error["px"] == 0.7
    assert len(train) == 14
    assert measured == [[i.name for i in train], [i.name for i in scene.images]]


def test_poses_of_a_device_are_advised_to_be_refined(room_of, as_by_a_device, tmp_path, splatseed):
    scene = as_by_a_device(load_scene(room_of(16, 160, 120).path), degrees=1.0)
    path = write_scene(scene, tmp_path / "bare", require_points=False).path
    poses = json.loads(splatseed("info", path, "--json").out)["poses"]
    assert poses["agreement"] > 0.3
    assert not poses["error"]["exact"]
    assert 0.1 < poses["error"]["degrees"] < 1
    told = splatseed("info", path).out
    assert re.search(r"px .* at 160 px a side: above 0.5 px", told)
    advised = told.partition("next")[2]
    assert f"splatseed train {path} --refine-poses --budget" in advised
    assert f"sfm {path / 'images'} --poses-from {path} -o OUT --refine-poses" in advised
