"""The commands that verbs print as the next: each works on the scene it was printed for."""

from __future__ import annotations

import dataclasses
import re
import shlex
import shutil
from pathlib import Path

import pytest

from splatseed.camera import Intrinsics
from splatseed.commands import next_steps
from splatseed.commands.next_steps import (
    Planned,
    Source,
    advice_commands,
    print_training,
    training_commands,
)
from splatseed.io import load_scene, write_scene
from splatseed.pointcloud import PointCloud
from splatseed.seeding.advice import AS_IT_IS, advice_for


def lines_of(out: str) -> list[list[str]]:
    """The words after ``splatseed`` of the commands below "next"."""
    printed = out.rpartition("\nnext\n")[2].splitlines()
    commands = [line.partition("splatseed ")[2] for line in printed]
    return [shlex.split(each) for each in commands if each]


@pytest.fixture
def bent(room_of, tmp_path) -> Path:
    """A small room, its lens said to have distortion."""
    scene = load_scene(room_of(9, 64, 48).path)
    lens = scene.intrinsics[0]
    params = (*lens.params, 0.06, 0.0, 0.0, 0.0)
    lens = Intrinsics(lens.camera_id, "OPENCV", lens.width, lens.height, params)
    images = tuple(dataclasses.replace(each, intrinsics=lens) for each in scene.images)
    path = tmp_path / "bent"
    write_scene(scene.replace(images=images, intrinsics=(lens,)), path, copy_images=True)
    return path


def follow(out: str, splatseed) -> list[str]:
    """Run what was printed, with few steps, and return the verbs."""
    verbs = []
    for words in lines_of(out):
        verbs.append(words[0])
        if "--max-steps" in words:
            words[words.index("--max-steps") + 1] = "3"
        if words[0] != "sfm":
            run = splatseed(*words)
            assert run.code == 0, (words, run.err)
    return verbs


@pytest.mark.parametrize("points", [True, False])
@pytest.mark.usefixtures("pycolmap_here")
def test_what_info_advises_works(points, bent, tmp_path, monkeypatch, splatseed):
    pytest.importorskip("torch", reason="trains")
    pytest.importorskip("pycolmap", reason="undistorts")
    scene, whole = tmp_path / "my scene", load_scene(bent)
    kept = whole if points else whole.replace(points=PointCloud.empty(), tracks=None)
    write_scene(kept, scene, copy_images=True, require_points=False)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(next_steps, "which", lambda _: None)  # as without a GPU
    run = splatseed("info", scene, "--max-steps", "30000")
    assert run.code == 0, run.err
    wanted = ["train", "train", "upsample", *([] if points else ["sfm"])]
    assert follow(run.out, splatseed) == ["undistort", *wanted]
    assert re.search(r"\n  train, about \d+ (s|minutes|hours) +splatseed train", run.out), run.out
    for folder in ("RUN", "SMALL"):
        assert (Path(folder) / "metrics.json").is_file()
    assert points or len(load_scene("OUT").points) > 500


def test_minutes_are_those_of_seeds_and_refinement_too(room, monkeypatch):
    monkeypatch.setattr(next_steps, "which", lambda _: None)  # as without a GPU
    monkeypatch.setattr(next_steps, "available_cpus", lambda: 1)
    scene = load_scene(room)
    planned, advice = Planned.of(scene)._replace(seconds=12.0), advice_for(scene, 1000)

    def label(method, *, refine):
        advised = dataclasses.replace(advice, method=method)
        return advice_commands(Source(room), scene, advised, planned, refine=refine)[0][0]

    count = len(scene.images)  # each takes 0.5 s of seeds, and 1.5 s of refinement
    assert label(AS_IT_IS, refine=False) == "train, about 12 s"
    assert label("auto", refine=False) == f"train, about {round(12 + 0.5 * count)} s"
    assert label("auto", refine=True) == f"train, about {round(12 + 2.0 * count)} s"


@pytest.mark.parametrize(("side", "steps"), [(480, 30000), (40, 30000), (480, 1000)])
def test_the_short_run_is_shorter_and_enlarges_nothing(side, steps, room, monkeypatch):
    monkeypatch.setattr(next_steps, "which", lambda _: None)  # as without a GPU
    monkeypatch.setattr(next_steps, "SMALL_SIDE", side)
    scene = load_scene(room)
    assert max(image.lens.width for image in scene.images) in range(41, 480)
    advice = dataclasses.replace(advice_for(scene, 1000), method=AS_IT_IS)
    planned = Planned.of(scene, max_steps=steps)
    commands = advice_commands(Source(room), scene, advice, planned, refine=False)
    short = [line for _, line in commands if "SMALL" in line]
    size = "--long-side 40 " if side == 40 else ""
    assert short == [f"splatseed train {room} {size}--max-steps 1500 -o SMALL"][: steps > 1500]


@pytest.mark.parametrize(("trainer", "points"), [("gsplat", True), ("nerfstudio", False)])
def test_the_advice_is_for_the_trainer_that_is_named(
    points, trainer, room, tmp_path, monkeypatch, splatseed
):
    whole = load_scene(room)
    kept = whole if points else whole.replace(points=PointCloud.empty(), tracks=None)
    path = write_scene(kept, tmp_path / "it", format="transforms", require_points=False).path
    monkeypatch.chdir(tmp_path)
    out = splatseed("info", path, "--for", trainer).out
    assert "strategy default" in out or not points
    seeds = out.rpartition("\nnext\n")[2].partition("splatseed ")[2].splitlines()[0]
    assert "upsample" in seeds  # 3DGS's densification gains by seeds, grow does not
    assert "--budget" not in seeds  # all that auto makes may be trained
    tight = splatseed("info", path, "--for", trainer, "--budget", "900").out
    assert "--budget 630 --auto.no-dense" in tight
    assert ("--format colmap" in seeds) == (trainer == "gsplat")
    assert splatseed(*shlex.split(seeds)).code == 0
    assert load_scene("OUT").source.format == ("colmap" if trainer == "gsplat" else "transforms")
    command = {
        "gsplat": "simple_trainer.py default --data_dir",
        "nerfstudio": "ns-train splatfacto",
    }
    assert f"{command[trainer]} " in out
    assert f"{tmp_path / 'OUT'}" in out


def test_only_commands_that_read_the_scene_exclude(room, bent):
    """Whatever the scene's name, also that of a verb."""
    source = Source(Path("train"), ("my photo.png", "b*"))
    options = "--exclude 'my photo.png' --exclude 'b*'"
    scene, read = load_scene(room), f"train {options} "
    advice = dataclasses.replace(advice_for(scene, 1000), method="mls")
    commands = advice_commands(source, scene, advice, Planned.of(scene), refine=False)
    assert [(line.split()[1], read in line) for _, line in commands] == [
        ("upsample", True), ("train", False),
    ]  # fmt: skip
    assert commands[1][1].startswith("splatseed train OUT --budget")
    advice = dataclasses.replace(advice, method=AS_IT_IS)
    gsplat = Planned.of(scene, trainer="gsplat")  # which leaves nothing out by itself
    commands = advice_commands(source, scene, advice, gsplat, refine=False)
    assert commands[0][1] == f"splatseed upsample {read}--method linear --ratio 1 -o OUT"
    scene = load_scene(bent)
    commands = advice_commands(source, scene, advice, Planned.of(scene), refine=False)
    assert commands[0][1] == f"splatseed undistort {read}-o train_undistorted"
    assert not any("--exclude" in line for _, line in commands[1:])


@pytest.mark.parametrize("kept", ["some", "no folder"])
def test_nothing_is_to_be_trained_without_its_photographs(kept, own_room, tmp_path, splatseed):
    images = own_room / "images"
    for path in sorted(images.iterdir())[3:]:
        path.unlink()
    if kept == "no folder":
        shutil.rmtree(images)
    missing = {"some": "put view_003.png and", "no folder": "beside the model"}
    for words in (("info", own_room), ("upsample", own_room, "-o", tmp_path / "out")):
        run = splatseed(*words)
        assert run.code == 0, run.err
        assert missing[kept] in run.out + run.err
        assert "splatseed train" not in run.out
        assert "gsplat" not in run.out
    if kept == "no folder":  # so that there is nothing to look at
        assert "-> mls" in run.err
        assert "Without photographs" in run.err
    advised = lines_of(splatseed("info", own_room).out)
    assert [words[0] for words in advised] == ["upsample"]


def test_a_cloud_alone_is_advised(room, tmp_path, monkeypatch, splatseed):
    monkeypatch.chdir(tmp_path)
    cloud = shutil.copy(room / "sparse" / "0" / "points3D.ply", tmp_path)
    advised = splatseed("info", cloud)
    assert "Points alone cannot be trained" in advised.err
    assert follow(advised.out, splatseed) == ["upsample"]


@pytest.mark.parametrize(("off", "told"), [(0.4, False), (3.0, True)])
def test_graphdecos_trainer_ignores_principal_points(off, told, room, capsys):
    scene = load_scene(room)
    lens = scene.intrinsics[0]
    fx, fy, cx, cy = lens.params
    lens = dataclasses.replace(lens, params=(fx, fy, cx, cy - off))
    images = tuple(dataclasses.replace(each, intrinsics=lens) for each in scene.images)
    print_training(Source(room), scene.replace(images=images), Path("out"), "colmap")
    said = capsys.readouterr()
    assert "graphdeco" in said.out
    assert (f"ignores principal points, which are up to {off} px off" in said.err) == told
    print_training(Source(room), scene.replace(images=images), Path("out"), "transforms")
    assert "ignores" not in capsys.readouterr().err  # that trainer does not read it


def test_only_trainers_that_undistort_are_named_for_a_distorted_scene(bent, tmp_path, splatseed):
    run = splatseed("upsample", bent, "--method", "mls", "-o", tmp_path / "out")
    after = run.out.partition("train it with\n")[2]
    named = [line.split()[0] for line in after.splitlines() if line.startswith("  ")]
    assert named == ["gsplat", "nerfstudio", "Brush", "OpenSplat", "LichtFeld", "Spirula"]
    assert "--undistort" in after.partition("LichtFeld")[2].partition("\n")[0]
    assert f"splatseed undistort {bent} -o {bent}_undistorted" in run.err


@pytest.mark.parametrize(
    ("model", "unable"),
    [
        ("OPENCV", set()),
        ("SIMPLE_RADIAL", set()),
        ("RADIAL", {"OpenSplat"}),  # its colmap.cpp throws
        ("OPENCV_FISHEYE", {"OpenSplat"}),  # and its nerfstudio.cpp takes k1 as of a perspective
    ],
)
def test_trainers_are_named_by_the_lenses_that_they_handle(model, unable):
    every = dict(training_commands(Path("out"), "colmap"))
    named = dict(training_commands(Path("out"), "colmap", frozenset({model})))
    assert every.keys() - named.keys() == {"splatseed", "graphdeco", *unable}
    assert "--undistort" in named["LichtFeld"]
    assert "--undistort" not in every["LichtFeld"]
