"""``splatseed upsample``: the scenes it writes, and what it prints."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import shutil
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import EntryPoint
from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from PIL import Image as PilImage

import splatseed as ss
from splatseed.camera import rotation_from_quat
from splatseed.commands.upsample.command import LoadedCloud
from splatseed.findings import Finding
from splatseed.io import load_scene, write_scene
from splatseed.io.matrices import read_cloud_transform
from splatseed.io.origin import translated
from splatseed.io.ply import read_ply, write_ply
from splatseed.io.seeds import method_of_points
from splatseed.io.staging import unlisted_files
from splatseed.methods import METHODS, SOURCE_CODES, chooses_number, configure, source_code
from splatseed.methods.registry import GROUP
from splatseed.pointcloud import PointCloud
from splatseed.seeding.cover import covered_share
from splatseed.seeding.photo_methods import frames_of
from splatseed.sfm.refinement import poses_of, turns
from splatseed.similarity import Similarity
from splatseed.splat.formats import read_gaussians
from splatseed.splat.training_frame import TrainingFrame
from splatseed.viewer.pictures import clouds_by_origin

from ..command_line import exit_code

WITH_RATIO = [name for name in METHODS if not chooses_number(name)]


@pytest.fixture(scope="module")
def surfaces(room_of):
    """The room's true surfaces."""
    return room_of(12, 96, 72).capture.surfaces


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
    assert (run.code, run.unexpected) == (0, "")
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


@pytest.fixture(scope="module")
def seeded(room, tmp_path_factory):
    """The room with the points of the default, and what was said."""
    out = tmp_path_factory.mktemp("seeded") / "my scene"
    with redirect_stdout(StringIO()) as said, redirect_stderr(said):
        assert exit_code("upsample", room, "--budget", 1200, "-o", out) == 0
    return out, said.getvalue()


def test_the_default_method_uses_the_photographs(seeded, room):
    out, said = seeded
    assert "at most 1,200 points" in said
    assert re.search(r"[\d,]+ original, [\d,]+ stereo, [\d,]+ cover", said)
    written = _manifest(out)
    shares, points = written["covered"], load_scene(out).points
    assert shares["cell"] == 8
    measured = points.xyz[points.source != source_code("cover")]
    frames, room_points = frames_of(load_scene(room)), load_scene(room).points.xyz
    for share, xyz in (("before", room_points), ("measured", measured), ("total", points.xyz)):
        assert shares[share] == pytest.approx(covered_share(frames, xyz), abs=1e-6)
    assert 0.1 < shares["before"] < shares["measured"] < shares["total"] <= 1
    assert re.search(
        rf"covered +{shares['measured']:.1%} of the 8 x 8 pixel cells .* hold points of the scene "
        rf"or points on surfaces that photographs confirm; {shares['before']:.1%} before\n"
        rf" +guessed +{shares['total'] - shares['measured']:.1%} hold only points guessed from "
        rf"neighbours by cover \({len(points) - len(measured):,} of {len(points):,} points\)",
        said,
    )
    assert (written["method"], written["budget"]) == ("auto", "1200")
    assert len(load_scene(out).points) <= 1200
    assert pycolmap.Reconstruction(out / "sparse/0").num_images() == 12


def test_the_same_seed_gives_the_same_bytes(seeded, room, tmp_path, splatseed, compare_anew):
    run = splatseed("upsample", room, "--budget", 1200, "--seed", 0, "-o", tmp_path / "0")
    assert (run.code, run.unexpected) == (0, "")
    assert _bytes(tmp_path / "0") == _bytes(seeded[0])
    assert _manifest(tmp_path / "0") == _manifest(seeded[0])


def test_another_seed_gives_other_bytes(seeded, room, tmp_path, splatseed):
    run = splatseed("upsample", room, "--budget", 1200, "--seed", 6, "-o", tmp_path / "6")
    assert (run.code, run.unexpected) == (0, "")
    assert _bytes(tmp_path / "6") != _bytes(seeded[0])


def test_the_commands_to_train_with_name_what_is_there(seeded):
    out, said = seeded
    lines = said.partition("train it with\n")[2].partition("note: ")[0].splitlines()
    commands = {line.split()[0]: shlex.split(line)[1:] for line in lines}
    assert next(iter(commands)) == "splatseed"
    others = {"gsplat", "graphdeco", "nerfstudio", "Brush", "OpenSplat", "LichtFeld", "Spirula"}
    assert set(commands) == {"splatseed", *others}
    for words in commands.values():
        assert str(out) in words  # one word, although it has a space
    words = commands["gsplat"]
    assert words[words.index("--data_factor") + 1] == "1"  # there is no images_2 beside images
    words = commands["nerfstudio"]
    assert (out / words[words.index("--colmap-path") + 1] / "images.bin").is_file()
    assert words[words.index("--downscale-factor") + 1] == "1"


def test_a_bare_ply_where_new_points_coincide(tmp_path, splatseed):
    xyz = np.random.default_rng(0).uniform(-1, 1, (250, 3)).astype(np.float32)
    # Pairs of the nearest that single precision can tell apart: points between them fall together.
    xyz = np.concatenate([xyz, np.nextafter(xyz[:50], np.float32(2))])
    write_ply(tmp_path / "cloud.ply", PointCloud(xyz, np.full(xyz.shape, (200, 0, 0), np.uint8)))
    words = ("upsample", tmp_path / "cloud.ply", "--method", "linear", "-o", tmp_path / "out")
    run = splatseed(*words, "--preview")
    assert re.search(r"left out .* [1-9]\d* duplicate", run.out), run
    told = re.search(r"points out +([\d,]+) \(([\d,]+) original, ([\d,]+) linear\)", run.out)
    total, *parts = (int(number.replace(",", "")) for number in told.groups())
    assert total == sum(parts) == len(read_ply(tmp_path / "out/sparse/0/points3D.ply"))
    assert "no images" in run.err
    assert "train it with" not in run.out
    with PilImage.open(tmp_path / "out/preview.png") as picture:
        colored = np.ptp(np.asarray(picture.convert("RGB")).astype(int), axis=2) > 20
    assert all(half.mean() > 0.002 for half in np.array_split(colored, 2, axis=1))


def test_transforms_in_transforms_out(room, tmp_path, splatseed):
    first, second = tmp_path / "first", tmp_path / "second"
    write_scene(load_scene(room), first, format="transforms")
    (first / "depths").unlink()
    run = splatseed("upsample", first, "-o", second, "--method", "mls")
    assert run.code == 0, run.err
    assert _manifest(second)["format"] == "both"
    assert run.out.count(f" {second}") >= 7  # a command for every trainer
    assert f"ns-train splatfacto --data {second}\n" in run.out  # reads transforms.json
    assert pycolmap.Reconstruction(second / "sparse/0").num_images() == 12
    before, after = load_scene(first), load_scene(second)
    np.testing.assert_array_equal(after.points.xyz[: len(before.points)], before.points.xyz)
    assert (second / "images").is_dir()
    # Depth maps that Brush would take for photographs: the layouts are written one by one.
    (first / "depths").symlink_to(room / "depths")
    run = splatseed("upsample", first, "-o", tmp_path / "third", "--method", "mls")
    assert run.code == 0, run.err
    assert not (tmp_path / "third/sparse").exists()
    command = run.err.partition("written by: ")[2].splitlines()[0]
    run = splatseed(*shlex.split(command)[1:])
    assert run.code == 0, run.err
    assert pycolmap.Reconstruction(tmp_path / "third-colmap/sparse/0").num_images() == 12


@pytest.mark.parametrize(
    ("flags", "chosen"),
    [
        (["--mls.k", 10], configure("mls", k=10)),
        (["--profile", "paper", "--mls.frame", "local"], configure("mls", "paper", frame="local")),
        (["--profile=paper", "--mls.frame=local"], configure("mls", "paper", frame="local")),
    ],
)
def test_flags_and_the_profile_set_a_methods_parameters(flags, chosen, room, tmp_path, splatseed):
    words = ("--method", "mls", *flags, "-o", tmp_path / "out")
    assert splatseed("upsample", room, *words).code == 0
    assert _manifest(tmp_path / "out")["parameters"] == dataclasses.asdict(chosen)
    written, expected = load_scene(tmp_path / "out").points, ss.upsample(load_scene(room), chosen)
    np.testing.assert_array_equal(written.xyz, expected.xyz)


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
    gaussians, seeds = read_gaussians(start), load_scene(out).points
    extent = np.ptp(seeds.xyz, axis=0).max()
    np.testing.assert_allclose(gaussians.means, seeds.xyz, atol=1e-6 * extent)


# Without points, or with wrong poses --------------------------------------------------------------


@pytest.fixture
def bare(room, tmp_path) -> Path:
    """The room in nerfstudio's layout, without its points."""
    scene = load_scene(room).replace(points=PointCloud.empty(), tracks=None, depths=None)
    write_scene(scene, tmp_path / "bare", format="transforms", require_points=False)
    return tmp_path / "bare"


def test_depth_maps_show_where_to_look(rgbd, tmp_path, splatseed):
    run = splatseed("upsample", rgbd, "--method", "stereo", "-o", tmp_path / "out")
    assert run.code == 0
    assert len(load_scene(tmp_path / "out").points) > 100


def test_photographs_without_points_are_seeded_and_drawn(bare, tmp_path, splatseed):
    out = tmp_path / "out"
    run = splatseed("upsample", bare, "--preview", "-o", out)
    assert (run.code, run.unexpected) == (0, "")
    assert "-> auto: no points" in run.err
    seeds = load_scene(out).points
    assert len(seeds) > 500
    assert not seeds.num_original
    for name in ("", "_origins", "_cells", "_maps"):
        assert str(out / f"preview{name}.png") in run.out
        assert (out / f"preview{name}.png").stat().st_size > 5000


@pytest.mark.usefixtures("pycolmap_here")
def test_poses_are_refined_and_points_triangulated(sharp_room, sharp_bare, tmp_path, splatseed):
    words = ("--refine-poses", "--method", "linear", "--ratio", 2)
    run = splatseed("upsample", sharp_bare, "-o", tmp_path / "out", *words)
    assert run.code == 0, run.err
    out = load_scene(tmp_path / "out")
    assert out.points.num_original > 100  # those that were triangulated
    assert len(out.points) > out.points.num_original
    bare, truth = load_scene(sharp_bare, require_points=False), poses_of(sharp_room.images)
    before, after = (np.median(turns(poses_of(each.images), truth)) for each in (bare, out))
    assert after < 0.3 * before


@pytest.fixture
def own_method(tmp_path, monkeypatch):
    """Installs the package that docs/methods.md shows."""
    page = (Path(__file__).parents[2] / "docs/methods.md").read_text("utf-8")
    own = page.partition("## Your own method")[2]
    (code,) = re.findall(r"```python\n(.*?)```", own, re.DOTALL)
    (name, value) = re.search(r"\[project.entry-points.*\n(\w+) = \"(.*)\"", own).groups()
    (tmp_path / "package").mkdir()
    (tmp_path / "package" / f"{value.partition(':')[0]}.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path / "package")
    monkeypatch.setitem(METHODS._plugins, name, EntryPoint(name, value, GROUP))
    *_, command = re.findall(r"^splatseed upsample SCENE (.*) -o OUT$", own, re.MULTILINE)
    return name, command.split()


def test_a_method_of_ones_own_is_named_as_the_origin(own_method, room, tmp_path, splatseed):
    name, words = own_method
    run = splatseed("upsample", room, *words, "-o", tmp_path / "out")
    assert (run.code, run.unexpected) == (0, "")
    new = 3 * len(load_scene(room).points)
    assert f" original, {new:,} {name})" in run.out
    assert re.search(
        rf"  not confirmed +\S+% hold only points made by {name} \({new:,} of ", run.out
    )
    scene = load_scene(tmp_path / "out")
    assert method_of_points(scene) == name
    clouds = clouds_by_origin(scene.points, TrainingFrame(np.zeros(3), 1.0), 100, name)
    assert [cloud.name for cloud in clouds] == ["original", name]
    assert method_of_points(load_scene(room)) == "other"


# Depth maps ---------------------------------------------------------------------------------------


def test_the_maps_are_named_and_noted_or_the_scenes_own(room, surfaces, tmp_path, splatseed):
    own, named, again = (tmp_path / name for name in ("own", "named", "again"))
    for out, scene, maps in (
        (own, room, ()),
        (named, room, ("--depth", room / "depths")),
        (again, named, ("--depth", room)),  # of the originals alone
    ):
        words = ("--method", "depth", *maps, "--ratio", 2, "-o", out)
        run = splatseed("upsample", scene, *words)
        assert (run.code, run.unexpected) == (0, "")
        np.testing.assert_array_equal(load_scene(out).points.xyz, load_scene(own).points.xyz)
    told = _manifest(named)
    assert told["depth"] == str((room / "depths").resolve())
    assert told["parameters"]["min_agreeing"] == 2
    points = load_scene(own).points
    assert np.median(surfaces.distance(points.xyz[points.source != 0].astype(float))) < 0.01
    maps = "Its 12 depth maps are not used by linear: method depth aligns them"
    words = ("--method", "linear", "-o")
    assert maps in splatseed("upsample", room, *words, tmp_path / "lines").err
    bare = write_scene(load_scene(room), tmp_path / "bare").path
    (bare / "depths").unlink()
    assert "depth maps" not in splatseed("upsample", bare, *words, tmp_path / "bare_lines").err
    run = splatseed("upsample", bare, "--method", "depth", "-o", tmp_path / "none")
    assert (run.code, run.unexpected.count("\n")) == (2, 1)
    assert "--depth" in run.unexpected


def test_a_capture_has_its_own_maps_and_needs_no_points(rgbd, surfaces, tmp_path, splatseed):
    out, lift = tmp_path / "out", ("--method", "depth", "--depth.no-align", "--num-points")
    run = splatseed("upsample", rgbd, *lift[:2], "-o", tmp_path / "plain")
    assert (run.code, run.unexpected) == (0, "")
    assert f"{round(0.25 * 96 * 72):,} points" in run.err
    run = splatseed("upsample", rgbd, *lift[:2], "--num-points", 700, "-o", out)
    assert (run.code, run.unexpected) == (0, "")
    assert "far from any original" not in run.out
    scene = load_scene(out)
    assert (len(scene.points), len(scene.images)) == (700, 12)
    # A PNG holds depth to a tenth of a millimetre.
    assert surfaces.distance(scene.points.xyz.astype(np.float64)).max() < 0.001
    maps = ("--depth", rgbd / "results", "--depth-scale", 5000)
    run = splatseed("upsample", out, *lift, 9, *maps, "-o", tmp_path / "again")
    assert run.code == 0, run.err
    assert "700 points" in run.err
    assert len(load_scene(tmp_path / "again").points) == 9
    mls, none = ("upsample", out, "--method", "mls"), "700"
    for words, says in (
        (("upsample", out, *lift[:2], *maps), "--depth.no-align"),
        (mls, none),
        (("bench", "--scenes", out), none),
    ):
        refused = splatseed(*words, "-o", tmp_path / "other")
        assert (refused.code, refused.err.count("\n")) == (2, 1), refused.err
        assert says in refused.err
        assert not (tmp_path / "other").exists()


def test_images_without_usable_depth_are_noted(own_room, tmp_path, splatseed):
    maps = sorted((own_room / "depths").glob("*.png"))
    for path in maps[:3]:
        path.unlink()
    shutil.copy(maps[7], maps[5])  # another image's depth
    words = ("--method", "depth", "--depth", own_room, "--ratio", 1.5, "-o", tmp_path / "out")
    run = splatseed("upsample", own_room, *words)
    assert run.code == 0
    assert "3 of 12 images" in run.err
    assert f"({maps[5].name}: " in run.err


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
    assert "120,000 points were read" in run.err
    assert re.search(r"voxels, 4\.\d GB of memory", run.err)
    told = json.loads((out / "splatseed.json").read_text())
    assert told["method"] == "cloud"
    assert len(told["cloud"]["files"]) == 2


def test_nerfstudios_transform_leads_from_the_scene_to_the_cloud(room, tmp_path):
    path = tmp_path / "dataparser_transforms.json"  # the scale after rotation and translation
    rows = np.column_stack([MOVE.rotation, MOVE.translation / MOVE.scale])
    path.write_text(json.dumps({"transform": rows.tolist(), "scale": MOVE.scale}))
    found = read_cloud_transform(path, load_scene(room))
    np.testing.assert_allclose(found.matrix, MOVE.inverse.matrix, rtol=1e-12)


def test_recentring_moves_scene_and_cloud_alike(splatseed, room, xyz, surfaces, tmp_path):
    grid = np.array([564000.0, 5932000.0, 90.0])
    far = translated(load_scene(room), -grid).replace(origin=np.zeros(3))
    write_scene(far, tmp_path / "far", copy_images=True)
    np.savez(tmp_path / "far.npz", xyz=MOVE.points(xyz))
    back = MOVE.inverse.then(Similarity(1.0, np.eye(3), grid))
    np.savetxt(tmp_path / "t.txt", back.matrix)
    words = ("upsample", tmp_path / "far", "--cloud", tmp_path / "far.npz", "-o", tmp_path / "out")
    refused = splatseed(*words)
    assert refused.code == 2
    assert "--transform" in refused.err
    run = splatseed(*words, "--transform", tmp_path / "t.txt", "--recenter", "--overwrite")
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
    new = out.points.xyz[out.points.source == CLOUD] + offset - grid
    assert len(new) > 500
    assert np.median(np.abs(surfaces.distance(new))) < 0.01


def test_any_scene_is_recentred_and_a_scan_in_its_grid_goes_with_it(splatseed, room, tmp_path):
    site, plain = np.array([40.0, -30.0, 2.0]), load_scene(room)
    write_scene(translated(plain, -site).replace(origin=np.zeros(3)), tmp_path / "site")
    words = ("upsample", tmp_path / "site", "-o", tmp_path / "out", "--recenter", "--method", "mls")
    run = splatseed(*words)
    assert run.code == 0, run.err
    assert "recenter.json" in run.out + run.err
    out = load_scene(tmp_path / "out")
    assert np.abs(out.offset - site).max() < 3
    # The written scene knows its grid: a scan in that goes where the scene is.
    np.savez(tmp_path / "scan.npz", xyz=plain.points.xyz + site)
    words = ("upsample", tmp_path / "out", "-o", tmp_path / "seeds", "--cloud")
    local = splatseed(*words, tmp_path / "scan.npz")
    assert local.code == 0, local.err
    seeds = load_scene(tmp_path / "seeds")
    new = seeds.points.xyz[seeds.points.source == CLOUD] + seeds.offset - site
    assert len(new) > 100
    assert np.abs(new).max() < np.abs(plain.points.xyz).max() + 0.1


SPOILT = {
    r"scan\.npz": lambda xyz: xyz,  # cut short
    "found 9 ": lambda xyz: np.full_like(xyz[:9], np.nan),
    r"none of 60,000, .* \(56\d{4}, 59\d{5}, .*--align.*--transform": lambda xyz: np.add(
        xyz, (564_000, 5_932_000, 87)
    ),  # a national grid
}


@pytest.mark.parametrize("says", SPOILT)
def test_a_spoilt_scan_is_refused(splatseed, room, xyz, tmp_path, says):
    path = tmp_path / "scan.npz"
    np.savez(path, xyz=SPOILT[says](xyz))
    if "scan" in says:
        path.write_bytes(path.read_bytes()[:-20_000])
    run = splatseed("upsample", room, "--cloud", path, "-o", tmp_path / "out")
    assert run.code == 2
    assert re.search(says, run.err.replace("\n", " "))
    assert len([line for line in run.err.splitlines() if line.startswith("error")]) == 1
    assert not list(tmp_path.glob("out*"))


def test_the_files_of_an_alignment_are_listed(splatseed, room, scan, tmp_path, monkeypatch):
    found = SimpleNamespace(
        report={},
        residuals=np.zeros(1),
        extent=1.0,
        sample=None,
        rgb=None,
        tie_points=None,
        finding=Finding("cloud-alignment", "", "info"),
    )
    monkeypatch.setattr(
        "splatseed.commands.upsample.command.load_cloud",
        lambda _, scene, method, __: LoadedCloud(scene, method.of(scan), alignment=found),
    )
    monkeypatch.setattr(
        "splatseed.viewer.clouds.preview_alignment", lambda *given: given[-1].touch()
    )
    out = tmp_path / "out"
    run = splatseed("upsample", room, "--cloud", scan, "-o", out)
    assert run.code == 0, run.err
    for name in ("alignment.json", "preview_alignment.png"):
        assert (out / name).is_file()
        assert str(out / name) in run.out
    assert unlisted_files(out) == []  # so that --overwrite replaces them


@pytest.mark.parametrize("method", ["cloud", "cover"])
def test_a_cloud_beside_cover(method, splatseed, room, tmp_path):
    few = load_scene(room).points
    write_ply(tmp_path / "part.ply", few.select(few.xyz[:, 0] < np.median(few.xyz[:, 0])))
    words = ("--cloud", tmp_path / "part.ply", "--method", method, "-o", tmp_path / "out")
    run = splatseed("upsample", room, *words)
    assert run.code == 0, run.err
    assert "The cloud covers" in run.err
    assert ("seeds the rest" in run.err) == (method == "cloud")
    found = set(load_scene(tmp_path / "out").points.source)
    assert (SOURCE_CODES["cover"] in found) == (method == "cover")
