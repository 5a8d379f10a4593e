"""``splatseed upsample``: what it writes, and what it says."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from PIL import Image as PilImage
from scipy.spatial.transform import Rotation

from splatseed.camera import rotation_from_quat
from splatseed.commands.upsample.cloud import LoadedCloud
from splatseed.io import load_scene, write_scene
from splatseed.io.cleaning import recentred
from splatseed.io.ply import read_ply, write_ply
from splatseed.io.staging import unlisted_files
from splatseed.pointcloud import PointCloud
from splatseed.similarity import Similarity
from splatseed.splat.formats import read_model
from splatseed.synthetic import make_capture
from splatseed.upsample import METHODS, SOURCE_CODES, chooses_number, configure

WITH_RATIO = [name for name in METHODS if not chooses_number(name)]


@pytest.fixture(scope="module")
def surfaces():
    """The room's true surfaces."""
    return make_capture(0, 3, 32, 32).surfaces


def _manifest(folder):
    return json.loads((folder / "splatseed.json").read_text())


def _bytes(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "splatseed.json"
    }


@pytest.mark.parametrize("method", WITH_RATIO)
def test_every_method_writes_a_scene_that_opens(method, room, tmp_path, splatseed):
    out = tmp_path / "out"
    maps = ["--depth", room] if method == "depth" else []
    run = splatseed("upsample", room, "--method", method, *maps, "--ratio", 3, "-o", out)
    assert (run.code, run.err) == (0, "")
    before, after = load_scene(room), load_scene(out)
    count = len(before.points)
    assert len(after.points) == 3 * count
    np.testing.assert_array_equal(after.points.xyz[:count], before.points.xyz)
    np.testing.assert_array_equal(after.points.rgb[:count], before.points.rgb)
    assert [image.name for image in after.images] == [image.name for image in before.images]
    model = pycolmap.Reconstruction(out / "sparse/0")
    assert (model.num_points3D(), model.num_images()) == (3 * count, 12)
    assert (out / "images" / after.images[0].name).is_file()
    written = _manifest(out)
    assert (written["method"], written["num_new"]) == (method, 2 * count)


def test_the_default_looks_at_the_photographs(room, tmp_path, splatseed):
    out = tmp_path / "out"
    run = splatseed("upsample", room, "--budget", 2000, "-o", out)
    assert (run.code, run.err) == (0, "")
    assert "at most 2,000 points" in run.out
    assert re.search(r"[\d,]+ original, [\d,]+ stereo, [\d,]+ cover", run.out)
    assert re.search(r"covered +[\d.]+% of the 8 x 8 pixel cells", run.out)
    written = _manifest(out)
    assert (written["method"], written["budget"]) == ("auto", "2000")
    assert len(load_scene(out).points) <= 2000
    assert pycolmap.Reconstruction(out / "sparse/0").num_images() == 12


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--budget", "300"), "at most 300 points, seed 0"),
        (("--method", "mls", "--budget", "1k"), "at most 1,000 points, seed 0"),
        (("--method", "mls", "--budget", "9k"), "-> mls ->"),
        (("--method", "mls", "--mls.k", "12", "--budget", "300"), "-> mls (k=12) ->"),
        (
            ("--method", "linear", "--ratio", "2", "--verify", "--cover", "8"),
            "(928 points before --verify and --cover, seed 0)",
        ),
        (("--method", "linear", "--ratio", "2"), "(928 points, seed 0)"),
        (("--method", "linear", "--profile", "paper"), "-> linear (profile paper) ->"),
    ],
)
def test_the_plan_has_the_number_and_what_was_changed(
    words, said, room, tmp_path, splatseed, monkeypatch
):
    def leave(*_, **__):
        raise SystemExit(0)

    monkeypatch.setattr("splatseed.commands.upsample.command.upsample", leave)  # only the plan
    run = splatseed("upsample", room, "-o", tmp_path / "out", *words)
    assert said in " ".join(run.out.split())
    assert "as the photographs need" not in run.out


def test_without_photographs_the_default_interpolates_and_says_so(own_room, tmp_path, splatseed):
    shutil.rmtree(own_room / "images")
    run = splatseed("upsample", own_room, "-o", tmp_path / "out")
    assert run.code == 0
    assert "-> mls" in run.out
    assert "Without photographs" in run.out + run.err


def test_the_origins_add_up_where_new_points_coincide(tmp_path, splatseed):
    coarse = np.float32(2**20)  # floats here are 1/8 apart: points between these fall together
    xyz = coarse + np.float32(np.random.default_rng(0).integers(0, 64, (300, 3))) / 8
    xyz = np.unique(xyz, axis=0).astype(np.float32)
    write_ply(tmp_path / "cloud.ply", PointCloud(xyz, np.zeros(xyz.shape, np.uint8)))
    run = splatseed("upsample", tmp_path / "cloud.ply", "--method", "linear", "-o", tmp_path / "o")
    assert re.search(r"left out .* [1-9]\d* duplicate", run.out), run
    told = re.search(r"points out +([\d,]+) \(([\d,]+) original, ([\d,]+) linear\)", run.out)
    total, *parts = (int(number.replace(",", "")) for number in told.groups())
    assert total == sum(parts)


def test_the_commands_to_train_with_name_what_is_there(room, tmp_path, splatseed):
    out = tmp_path / "my scene"
    commands = _commands(splatseed("upsample", room, "-o", out).out)
    others = {"gsplat", "graphdeco", "nerfstudio", "Brush", "OpenSplat", "LichtFeld"}
    assert set(commands) == {"splatseed", *others}
    assert next(iter(commands)) == "splatseed"
    for words in commands.values():
        assert str(out) in words  # one word, although it has a space
    assert commands["Brush"][0] == "brush"
    words = commands["gsplat"]
    assert words[words.index("--data_factor") + 1] == "1"  # there is no images_2 beside images
    words = commands["nerfstudio"]
    assert (out / words[words.index("--colmap-path") + 1] / "images.bin").is_file()
    assert words[words.index("--downscale-factor") + 1] == "1"


def _commands(out):
    """Trainer to the words of its command, from the last lines of the output."""
    lines = out.partition("train it with\n")[2].partition("note: ")[0].splitlines()
    return {line.split()[0]: shlex.split(line)[1:] for line in lines}


def test_transforms_in_transforms_out(room, tmp_path, splatseed):
    first, second = tmp_path / "first", tmp_path / "second"
    splatseed(
        "upsample", room, "-o", first, "--format", "transforms", "--method", "mls", "--ratio", 1
    )
    run = splatseed("upsample", first, "-o", second, "--method", "mls", "--ratio", 2)
    assert run.code == 0
    assert _manifest(second)["format"] == "transforms"
    before, after = load_scene(first), load_scene(second)
    np.testing.assert_array_equal(after.points.xyz[: len(before.points)], before.points.xyz)
    assert (second / "images").is_dir()
    run = splatseed(
        "upsample", first, "-o", tmp_path / "third", "--format", "colmap", "--method", "mls"
    )
    assert run.code == 0
    assert pycolmap.Reconstruction(tmp_path / "third/sparse/0").num_images() == 12


def test_a_bare_ply(room, tmp_path, splatseed):
    write_ply(tmp_path / "cloud.ply", load_scene(room).points)
    run = splatseed("upsample", tmp_path / "cloud.ply", "-o", tmp_path / "out", "--preview")
    assert run.code == 0
    assert "no images" in run.out
    assert "train it with" not in run.out
    assert len(read_ply(tmp_path / "out/sparse/0/points3D.ply")) > 0
    _assert_drawn(tmp_path / "out/preview.png")


def test_a_number_of_points_is_met_and_told(room, tmp_path, splatseed):
    out, words = tmp_path / "out", ("--method", "mls", "--num-points", 1234)
    run = splatseed("upsample", room, *words, "-o", out)
    before, _, after = run.out.partition("\nsplatseed upsample\n")
    assert "1,234 points" in before  # said before it is done
    for text in (
        "1,234",
        "464",
        "seconds",
        "read ",
        "write ",
        "far from any",
        "train it with",
        out,
    ):
        assert str(text) in after
    assert len(load_scene(out).points) == 1234
    told = _manifest(out)
    assert (told["ratio"], told["num_points_asked"], told["num_points"]) == (None, 1234, 1234)


def test_flags_and_the_profile_set_a_methods_parameters(room, tmp_path, splatseed):
    paper = configure("mls", "paper")
    for name, flags, changed in (
        ("plain", [], configure("mls")),
        ("ten", ["--mls.k", 10], configure("mls", k=10)),
        ("paper", ["--profile", "paper", "--mls.frame", "local"], None),
        ("same", ["--profile=paper", "--mls.frame=local"], None),
    ):
        words = ("--method", "mls", *flags, "-o", tmp_path / name)
        assert splatseed("upsample", room, *words).code == 0
        told = _manifest(tmp_path / name)["parameters"]
        if changed is None:
            assert (told["k"], told["placement"]) == (paper.k, paper.placement)
            assert (paper.frame, told["frame"]) == ("world", "local")
        else:
            assert told["k"] == changed.k
    assert _bytes(tmp_path / "ten") != _bytes(tmp_path / "plain")
    assert _bytes(tmp_path / "paper") == _bytes(tmp_path / "same")


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(room, tmp_path, splatseed):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        assert splatseed("upsample", room, "-o", tmp_path / name, "--seed", seed).code == 0
    assert _bytes(tmp_path / "a") == _bytes(tmp_path / "b")
    assert _bytes(tmp_path / "a") != _bytes(tmp_path / "c")
    assert _manifest(tmp_path / "a") == _manifest(tmp_path / "b")


def _assert_drawn(path):
    with PilImage.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert min(pixels.shape[:2]) > 100
    colored = np.ptp(pixels, axis=2) > 20  # neither paper nor ink
    assert all(half.mean() > 0.002 for half in np.array_split(colored, 2, axis=1))


def test_images_are_linked_or_copied_and_an_output_replaced(room, tmp_path, splatseed):
    out, words = tmp_path / "out", ("upsample", room, "--method", "mls", "-o", tmp_path / "out")
    assert splatseed(*words, "--ratio", 2).code == 0
    assert (out / "images").resolve() == (room / "images").resolve()
    assert splatseed(*words, "--ratio", 3, "--copy-images", "--overwrite").code == 0
    assert not (out / "images").is_symlink()
    for file in (out / "images").iterdir():
        assert file.read_bytes() == (room / "images" / file.name).read_bytes()
    assert len(load_scene(out).points) == 3 * len(load_scene(room).points)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_first_gaussians_stand_where_the_seeds_are(room, tmp_path, splatseed):
    out, start = tmp_path / "out", tmp_path / "start.ply"
    words = ("upsample", room, "--method", "mls", "--ratio", 2, "-o", out, "--gaussians", start)
    run = splatseed(*words)
    assert run.code == 0, run.err
    assert str(start) in run.out + run.err
    gaussians, seeds = read_model(start), load_scene(out).points
    extent = np.ptp(seeds.xyz, axis=0).max()
    np.testing.assert_allclose(gaussians.means, seeds.xyz, atol=1e-6 * extent)
    sizes = np.exp(gaussians.scales)
    assert (sizes > 0).all()
    assert (sizes < extent).all()
    fitted = 0.5 + 0.28209479 * gaussians.sh0[:, 0]
    assert 0 < np.abs(fitted - seeds.rgb / 255.0).mean() < 0.2  # near the seeds' own


# Without points, or with wrong poses --------------------------------------------------------------


@pytest.fixture
def bare(room, tmp_path) -> Path:
    """The room in nerfstudio's layout, without its points."""
    folder = tmp_path / "bare"
    write_scene(load_scene(room), folder, format="transforms")
    for path in folder.glob("*.ply"):
        path.unlink()
    (folder / "splatseed.json").unlink(missing_ok=True)
    return folder


def test_depth_maps_show_where_to_look(rgbd, tmp_path, splatseed):
    run = splatseed("upsample", rgbd, "--method", "stereo", "-o", tmp_path / "out")
    assert run.code == 0
    assert "photographs, around its depth maps\n" in run.out
    assert len(load_scene(tmp_path / "out").points) > 100


def test_wrong_axes_are_named_before_the_search(bare, tmp_path, splatseed):
    content = json.loads((bare / "transforms.json").read_text())
    for frame in content["frames"]:
        opengl = np.array(frame["transform_matrix"])
        frame["transform_matrix"] = (opengl @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()
    (bare / "transforms.json").write_text(json.dumps(content))
    run = splatseed("upsample", bare, "-o", tmp_path / "out")
    assert run.code == 2
    assert "once the y and z axes of every camera are negated" in run.err
    assert "transform_matrix is world_from_cam, with OpenGL's camera axes" in run.err
    assert not (tmp_path / "out").exists()


def test_photographs_without_points_are_seeded_and_drawn(bare, tmp_path, splatseed):
    out = tmp_path / "out"
    run = splatseed("upsample", bare, "--preview", "-o", out)
    assert (run.code, run.err) == (0, "")
    assert "-> auto: no points, so depth is found by comparing photographs\n" in run.out
    assert "note: There were no points to begin from: comparing the photographs gave" in run.out
    seeds = load_scene(out).points
    assert len(seeds) > 500
    assert not seeds.num_original
    for name in ("", "_origins", "_cells", "_maps"):
        assert str(out / f"preview{name}.png") in run.out
        assert (out / f"preview{name}.png").stat().st_size > 5000


def test_poses_are_refined_and_points_triangulated(sharp_room, sharp_bare, tmp_path, splatseed):
    run = splatseed("upsample", sharp_bare, "-o", tmp_path / "out", "--refine-poses")
    assert run.code == 0, run.err
    assert "note: Refined poses lower the mean reprojection error from" in run.out
    out = load_scene(tmp_path / "out")
    assert out.points.num_original > 100  # those that were triangulated
    assert len(out.points) > out.points.num_original
    bare = load_scene(sharp_bare, require_points=False)
    assert _median_turn(out, sharp_room) < 0.2 * _median_turn(bare, sharp_room)


def _median_turn(scene, truth):
    """Degrees between the cameras' directions to each other, whatever the world's frame."""
    of = {image.name: image.camera.cam_from_world[:3, :3] for image in truth.images}
    pairs = [(image.camera.cam_from_world[:3, :3], of[image.name]) for image in scene.images]
    apart = [found @ true.T for found, true in pairs]
    relative = [Rotation.from_matrix(apart[0].T @ each).magnitude() for each in apart[1:]]
    return np.degrees(np.median(relative))


# Depth maps ---------------------------------------------------------------------------------------


def test_the_maps_are_named_and_noted_or_the_scenes_own(room, surfaces, tmp_path, splatseed):
    clouds = []
    for name, words in (("own", ()), ("named", ("--depth", room / "depths"))):
        how = (*words, "--method", "depth", "--ratio", 2, "-o", tmp_path / name)
        run = splatseed("upsample", room, *how)
        assert (run.code, run.err) == (0, "")
        for stage in ("read images", "synchronize scales", "compare views", "choose points"):
            assert stage in run.out
        clouds.append(load_scene(tmp_path / name).points)
    np.testing.assert_array_equal(clouds[0].xyz, clouds[1].xyz)
    told = _manifest(tmp_path / "named")
    assert told["depth"] == str((room / "depths").resolve())
    assert told["parameters"]["min_agreeing"] == 2
    new = clouds[1].xyz[clouds[1].source != 0].astype(np.float64)
    assert np.median(surfaces.distance(new)) < 0.01
    again = ("--method", "depth", "--depth", room, "--ratio", 2, "-o", tmp_path / "again")
    assert splatseed("upsample", tmp_path / "named", *again).code == 0  # of the originals alone
    np.testing.assert_array_equal(load_scene(tmp_path / "again").points.xyz, clouds[0].xyz)
    bare = write_scene(load_scene(room), tmp_path / "bare").path
    (bare / "depths").unlink()
    run = splatseed("upsample", bare, "--method", "depth", "-o", tmp_path / "none")
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert "maps of none of them. Name the folder with the maps: --depth DIR." in run.err


def test_a_capture_has_its_own_maps_and_needs_no_points(rgbd, surfaces, tmp_path, splatseed):
    out = tmp_path / "out"
    words = ("--method", "depth", "--depth.no-align")
    run = splatseed("upsample", rgbd, *words, "--num-points", 700, "-o", out)
    assert (run.code, run.err) == (0, "")
    assert "far from any original" not in run.out
    scene = load_scene(out)
    assert (len(scene.points), len(scene.images)) == (700, 12)
    assert (out / "images" / scene.images[0].name).is_file()
    # A PNG holds depth to a tenth of a millimetre.
    assert surfaces.distance(scene.points.xyz.astype(np.float64)).max() < 0.001
    assert "made 700 of its points and kept 0." in splatseed("info", out).out
    for given, says in (
        (["--depth.no-align"], "num_points"),
        (["--num-points", 9], "--poses-from"),
    ):
        refused = splatseed("upsample", rgbd, *words[:2], *given, "-o", tmp_path / "other")
        assert (refused.code, refused.err.count("\n")) == (2, 1)
        assert says in refused.err
    maps = ("--depth", rgbd / "results", "--depth-scale", 5000, "--num-points", 9)
    run = splatseed("upsample", out, *words, *maps, "-o", tmp_path / "again")
    assert run.code == 0, run.err
    assert "None is an original: the 700 points that splatseed added" in run.out
    assert len(load_scene(tmp_path / "again").points) == 9
    for verb in (
        ["upsample", out, "--method", "mls", "-o", tmp_path / "mls"],
        ["upsample", out, "--method", "mls", "--tile-points", 100, "-o", tmp_path / "mls"],
        ["tune", out, "-o", tmp_path / "tune"],
        ["bench", "--scenes", out, "-o", tmp_path / "bench"],
    ):
        run = splatseed(*verb)
        assert (run.code, run.err.count("\n")) == (2, 1), run.err
        assert "found none: it made all 700" in run.err
        assert not verb[-1].exists()


def test_images_left_out_are_told(own_room, tmp_path, splatseed):
    maps = sorted((own_room / "depths").glob("*.png"))
    for path in maps[:3]:
        path.unlink()
    shutil.copy(maps[7], maps[5])  # another image's depth
    words = ("--method", "depth", "--depth", own_room, "--ratio", 1.5, "-o", tmp_path / "out")
    run = splatseed("upsample", own_room, *words)
    assert run.code == 0
    assert "3 of 12 images have no depth map and give no points." in run.out
    assert f"({maps[5].name}: depth is off by" in run.out


# Clouds -------------------------------------------------------------------------------------------


CLOUD = SOURCE_CODES["cloud"]
MOVE = Similarity(
    0.5, rotation_from_quat(np.array([0.8, 0.0, 0.6, 0.0])), np.array([7e5, 4e6, 0.0])
)


@pytest.fixture(scope="module")
def xyz(surfaces):
    return surfaces.sample(60_000, np.random.default_rng(2))


@pytest.fixture(scope="module")
def scan(tmp_path_factory, xyz):
    path = tmp_path_factory.mktemp("scan") / "scan.npz"
    np.savez(path, xyz=xyz)
    return path


def test_a_scan_in_the_scenes_frame(splatseed, room, scan, tmp_path):
    out = tmp_path / "out"
    run = splatseed(
        "upsample", room, "--cloud", scan, "--cloud", scan, "-o", out, "--budget", "1.5k"
    )
    assert run.code == 0, run.err
    seeds = load_scene(out).points
    assert len(seeds) == 1500
    assert CLOUD in seeds.source
    assert "cloud)" in run.out
    assert "120,000 points were read" in run.err + run.out
    assert re.search(r"voxels, 4\.\d GB of memory", run.out)
    told = json.loads((out / "splatseed.json").read_text())
    assert told["method"] == "cloud"
    assert len(told["cloud"]["files"]) == 2


@pytest.mark.parametrize("name", ["t.txt", "t.json", "dataparser_transforms.json"])
def test_transforms_from_files(splatseed, room, scan, xyz, surfaces, tmp_path, name):
    back, moved = MOVE.inverse, tmp_path / "moved.npz"
    np.savez(moved, xyz=MOVE.points(xyz))
    if name == "t.txt":
        np.savetxt(tmp_path / name, np.vstack([back.matrix, [0, 0, 0, 1]]))
    elif name == "t.json":
        content = {"matrix": [*back.matrix.tolist(), [0, 0, 0, 1]]}
        (tmp_path / name).write_text(json.dumps(content))
    else:  # from the scene to nerfstudio's world: scale after rotation and translation
        rows = np.column_stack([MOVE.rotation, MOVE.translation / MOVE.scale])
        content = {"transform": rows.tolist(), "scale": MOVE.scale}
        (tmp_path / name).write_text(json.dumps(content))
    words = ("--transform", tmp_path / name, "-o", tmp_path / "out")
    run = splatseed("upsample", room, "--cloud", moved, *words)
    assert run.code == 0, run.err
    splatseed("upsample", room, "--cloud", scan, "-o", tmp_path / "plain")
    first, second = (load_scene(tmp_path / each).points for each in ("plain", "out"))
    assert abs(len(first) - len(second)) < 0.01 * len(first)
    off = surfaces.distance(second.xyz[second.source == CLOUD].astype(float))
    assert np.median(np.abs(off)) < 0.01


def test_recentring_moves_scene_and_cloud_alike(splatseed, room, xyz, tmp_path):
    grid = np.array([564000.0, 5932000.0, 90.0])
    far = recentred(load_scene(room), -grid)
    write_scene(far, tmp_path / "far", copy_images=True)
    np.savez(tmp_path / "far.npz", xyz=xyz + grid)
    words = ("upsample", tmp_path / "far", "--cloud", tmp_path / "far.npz", "-o", tmp_path / "out")
    refused = splatseed(*words)
    assert refused.code == 2
    assert "--recenter" in refused.err
    run = splatseed(*words, "--recenter", "--overwrite")
    assert run.code == 0, run.err
    assert unlisted_files(tmp_path / "out") == []
    offset = np.array(json.loads((tmp_path / "out" / "recenter.json").read_text())["offset"])
    assert np.abs(offset - grid).max() < 3
    out, plain = load_scene(tmp_path / "out"), load_scene(room)
    for new, old in zip(out.images, plain.images, strict=True):
        np.testing.assert_allclose(new.camera.center + offset - grid, old.camera.center, atol=1e-6)
    np.testing.assert_allclose(
        out.tracks.xyz + offset - grid, plain.tracks.xyz[: len(out.tracks)], atol=1e-6
    )


SPOILT = {
    r"scan\.npz to be an archive of NumPy arrays": lambda xyz: xyz,  # cut short
    "points with finite coordinates in .*found none": lambda xyz: xyz[:0],
    "found 9 that are not finite": lambda xyz: np.full_like(xyz[:9], np.nan),
    r"none of 60,000, .* \(56\d{4}, 59\d{5}, .*--align.*--recenter would": lambda xyz: np.add(
        xyz, (564_000, 5_932_000, 87)
    ),  # a national grid
    "at its depth. It is in another frame .* or of another place": lambda xyz: np.column_stack(
        [3 * xyz[:, :2], 0.5 * np.sin(xyz[:, 0])]
    ),
    "found none of 1,000,000": lambda xyz: np.repeat(xyz[:1] + 9, 1_000_000, axis=0),
}


@pytest.mark.parametrize("says", SPOILT)
def test_what_is_wrong_with_a_scan_is_one_line(splatseed, room, xyz, tmp_path, says):
    path = tmp_path / "scan.npz"
    np.savez(path, xyz=SPOILT[says](xyz))
    if "archive" in says:
        path.write_bytes(path.read_bytes()[:-20_000])
    run = splatseed("upsample", room, "--cloud", path, "-o", tmp_path / "out")
    assert run.code == 2
    assert re.search(says, run.err.replace("\n", " "))
    assert len([line for line in run.err.splitlines() if line.startswith("error")]) == 1
    assert not list(tmp_path.glob("out*"))


def test_the_files_of_an_alignment_are_listed(splatseed, room, scan, tmp_path, monkeypatch):
    found = SimpleNamespace(
        report={}, residuals=np.zeros(1), extent=1.0, sample=None, rgb=None, marks=None, sentence=""
    )
    monkeypatch.setattr(
        "splatseed.commands.upsample.command.load_cloud",
        lambda _, scene, method, __: LoadedCloud(scene, method.of(scan), alignment=found),
    )
    monkeypatch.setattr("splatseed.view.clouds.preview_alignment", lambda *given: given[-1].touch())
    out = tmp_path / "out"
    run = splatseed("upsample", room, "--cloud", scan, "-o", out)
    assert run.code == 0, run.err
    for name in ("alignment.json", "preview_alignment.png"):
        assert (out / name).is_file()
        assert str(out / name) in run.out
    assert unlisted_files(out) == []  # so that --overwrite replaces them


def test_a_cloud_beside_cover(splatseed, room, scan, tmp_path):
    few = load_scene(room).points
    write_ply(tmp_path / "part.ply", few.select(few.xyz[:, 0] < np.median(few.xyz[:, 0])))
    words = ("--cloud", scan, "--method", "cover", "-o", tmp_path / "out", "--preview")
    run = splatseed("upsample", room, *words)
    assert run.code == 0, run.err
    for i, method in enumerate(("cloud", "cover")):
        words = ("--cloud", tmp_path / "part.ply", "--method", method, "-o", tmp_path / f"part{i}")
        run = splatseed("upsample", room, *words)
        assert "The cloud covers" in run.out
        assert ("seeds the rest" in run.out) == (method == "cloud")
    assert {0, CLOUD, SOURCE_CODES["cover"]} <= set(load_scene(tmp_path / "out").points.source)
