"""``splatseed upsample`` on the procedural room: what it writes, and what it says."""

from __future__ import annotations

import json
import re
import shlex
import shutil

import numpy as np
import pycolmap
import pytest
from PIL import Image as PilImage

from splatseed.io import load_scene, write_scene
from splatseed.io.ply import read_ply, write_ply
from splatseed.pointcloud import PointCloud
from splatseed.upsample import METHODS, chooses_number, configure

METHOD_NAMES = list(METHODS)
WITH_RATIO = [name for name in METHOD_NAMES if not chooses_number(name)]


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


def test_the_closing_table_has_what_was_asked_for(room, tmp_path, splatseed):
    out = tmp_path / "out"
    run = splatseed("upsample", room, "--method", "mls", "--ratio", 2, "-o", out)
    count = len(load_scene(room).points)
    for text in (f"{count:,}", f"{2 * count:,}", "seconds", "read ", "write ", "far from any", out):
        assert str(text) in run.out
    before, _, after = run.out.partition("\nsplatseed upsample\n")
    assert f"{2 * count:,} points" in before  # said before it is done
    assert "train it with" in after


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


def test_only_what_reads_transforms_json_is_offered_for_it(room, tmp_path, splatseed):
    out = tmp_path / "out"
    run = splatseed("upsample", room, "-o", out, "--format", "transforms")
    assert set(_commands(run.out)) == {"splatseed", "nerfstudio", "Brush", "OpenSplat"}
    assert (out / "transforms.json").is_file()
    assert not (out / "sparse").exists()


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


def test_a_methods_flag_changes_the_method(room, tmp_path, splatseed):
    for name, flags in (("plain", []), ("ten", ["--mls.k", 10])):
        run = splatseed("upsample", room, "-o", tmp_path / name, "--method", "mls", *flags)
        assert run.code == 0
    assert _manifest(tmp_path / "ten")["parameters"]["k"] == 10
    assert _manifest(tmp_path / "plain")["parameters"]["k"] == configure("mls").k
    assert _bytes(tmp_path / "ten") != _bytes(tmp_path / "plain")


@pytest.mark.parametrize("profile", [["--profile", "paper"], ["--profile=paper"]])
def test_the_paper_profile_sets_defaults_and_flags_still_win(profile, room, tmp_path, splatseed):
    words = ["upsample", room, "-o", tmp_path / "out", "--method", "mls", *profile]
    assert splatseed(*words, "--mls.frame", "local").code == 0
    written = _manifest(tmp_path / "out")
    paper = configure("mls", "paper")
    assert written["profile"] == "paper"
    assert written["parameters"]["k"] == paper.k
    assert written["parameters"]["placement"] == paper.placement
    assert (paper.frame, written["parameters"]["frame"]) == ("world", "local")


def test_a_number_of_points_is_met(room, tmp_path, splatseed):
    run = splatseed(
        "upsample", room, "--method", "mls", "-o", tmp_path / "out", "--num-points", 1234
    )
    assert "1,234" in run.out
    assert len(load_scene(tmp_path / "out").points) == 1234
    written = _manifest(tmp_path / "out")
    assert (written["ratio"], written["num_points_asked"], written["num_points"]) == (
        None,
        1234,
        1234,
    )


def test_the_same_seed_gives_the_same_bytes_and_another_does_not(room, tmp_path, splatseed):
    for name, seed in (("a", 5), ("b", 5), ("c", 6)):
        assert splatseed("upsample", room, "-o", tmp_path / name, "--seed", seed).code == 0
    assert _bytes(tmp_path / "a") == _bytes(tmp_path / "b")
    assert _bytes(tmp_path / "a") != _bytes(tmp_path / "c")
    assert _manifest(tmp_path / "a") == _manifest(tmp_path / "b")


def test_previews_show_something(room, tmp_path, splatseed):
    out = tmp_path / "out"
    run = splatseed("upsample", room, "-o", out, "--preview")
    for name in ("preview.png", "preview_maps.png"):
        assert str(out / name) in run.out
        _assert_drawn(out / name)


def test_a_preview_runs_the_method_asked_for_and_no_other(room, tmp_path, splatseed, monkeypatch):
    def runs(self, *_):
        raise AssertionError(type(self))

    for other in ("linear", "voronoi", "cover", "stereo", "auto"):
        monkeypatch.setattr(METHODS[other], "__call__", runs)
    out = tmp_path / "out"
    run = splatseed("upsample", room, "--method", "mls", "-o", out, "--preview")
    assert (run.code, run.err) == (0, "")
    _assert_drawn(out / "preview.png")
    assert not (out / "preview_methods.png").exists()


def _assert_drawn(path):
    with PilImage.open(path) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert min(pixels.shape[:2]) > 100
    colored = np.ptp(pixels, axis=2) > 20  # neither paper nor ink
    assert all(half.mean() > 0.002 for half in np.array_split(colored, 2, axis=1))


def test_images_are_linked_or_copied(room, tmp_path, splatseed):
    splatseed("upsample", room, "-o", tmp_path / "linked")
    splatseed("upsample", room, "-o", tmp_path / "copied", "--copy-images")
    assert (tmp_path / "linked/images").resolve() == (room / "images").resolve()
    copied = tmp_path / "copied/images"
    assert not copied.is_symlink()
    for file in copied.iterdir():
        assert file.read_bytes() == (room / "images" / file.name).read_bytes()


def test_an_earlier_output_is_replaced_when_asked(room, tmp_path, splatseed):
    out = tmp_path / "out"
    for ratio, words in ((2, []), (3, ["--overwrite"])):
        assert (
            splatseed("upsample", room, "--method", "mls", "-o", out, "--ratio", ratio, *words).code
            == 0
        )
    assert len(load_scene(out).points) == 3 * len(load_scene(room).points)
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_photographs_without_points_are_seeded_and_drawn(room, tmp_path, splatseed):
    """Poses and photographs, as of an RGB-D capture, and no point to choose a view by."""
    bare = tmp_path / "bare"
    write_scene(load_scene(room), bare, format="transforms")
    content = json.loads((bare / "transforms.json").read_text())
    del content["ply_file_path"]
    (bare / "transforms.json").write_text(json.dumps(content))
    out = tmp_path / "out"
    run = splatseed("upsample", bare, "--preview", "-o", out)
    assert (run.code, run.err) == (0, "")
    assert len(load_scene(out).points) > 500
    pictures = ("", "_origins", "_cells", "_maps")
    assert all((out / f"preview{name}.png").stat().st_size > 5000 for name in pictures)
