"""``splatseed train``: its --config, its progress line, and --refine-poses."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from rich.progress import Progress

from splatseed.commands.train import bar_columns, parse
from splatseed.console import LiteralConsole
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene, write_scene
from splatseed.pointcloud import PointCloud
from splatseed.sfm import Refinement, refined_scene

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.viewer.models import open_item

SHORT = ("--max-steps", "3", "--data-factor", "2")


def test_steps_and_time_left_are_always_there():
    out = StringIO()
    console = LiteralConsole(file=out, force_terminal=True, width=48, color_system=None)
    bar = Progress(*bar_columns(), console=console, expand=True, auto_refresh=False)
    line = "PSNR 27.31, test 26.05 dB  1,234,567 Gaussians"
    bar.add_task(line, total=30_000, completed=12_345, left="1:02:03 left")
    console.print(bar.get_renderable())
    (line,) = out.getvalue().splitlines()
    assert "12345/30000 1:02:03 left" in line


def test_a_file_gives_options_and_the_command_line_wins(tmp_path):
    toml = tmp_path / "run.toml"
    toml.write_text(
        'scene = "room"\nmax_steps = 7\nopacity_reset = true\nseeds = "scene"\nbudget = 900\n'
    )
    options = parse(["-o", "out", "--config", str(toml)])
    assert (options.scene, options.output) == (Path("room"), Path("out"))
    settings = options.request.settings
    assert (settings.max_steps, settings.opacity_reset, settings.seeding) == (7, True, "scene")
    assert options.request.budget == 900
    assert options.request.named == {"max_steps", "opacity_reset", "seeding"}
    options = parse(["mine", f"--config={toml}", "--max-steps=9", "-o", "out"])
    assert (options.scene, options.request.settings.max_steps) == (Path("mine"), 9)
    for one, other in (("long_side", "data_factor"), ("data_factor", "long_side")):
        toml.write_text(f"{one} = 8\n")
        words = ["mine", "-o", "out", "--config", str(toml), f"--{other.replace('_', '-')}", "4"]
        request = parse(words).request
        sizes = {"long_side": request.long_side, "data_factor": request.settings.data_factor}
        assert sizes == {one: None, other: 4}
    with pytest.raises(SceneNotFoundError):
        parse(["--config", str(tmp_path / "none.toml")])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("max_stepz = 3", r"max_steps\?"),
        ("max_steps = [1]", "max_steps"),
        ("max_steps = true", "max_steps"),
        ("max_steps 3", r"run\.toml"),
    ],
)
def test_a_wrong_option_of_a_config_is_named(content, said, tmp_path):
    (tmp_path / "run.toml").write_text(content)
    with pytest.raises(SceneFormatError, match=said):
        parse(["--config", str(tmp_path / "run.toml")])


@pytest.fixture
def refining(room, monkeypatch):
    """Stands in for pycolmap: poses and points are the room's. Its list tells the calls."""
    truth, calls = load_scene(room), []

    def call(folder, staging, settings, progress, kept, job, poses, test_names, masks, has_points):
        assert job is refined_scene._refine
        assert not has_points
        assert test_names == {image.name for image in truth.split(8)[1]}
        calls.append(folder)
        change = Refinement(False, 9.0, 0.5, 0.1, 0.2, 0.1, 0.2)
        return refined_scene._Refined(truth.images, truth.points, change)

    monkeypatch.setattr(refined_scene, "call", call)
    return calls


@pytest.fixture
def bare(room, as_by_a_device, tmp_path):
    """The room with poses that are off, and no points."""
    write_scene(as_by_a_device(load_scene(room)), tmp_path / "bare", require_points=False)
    return tmp_path / "bare"


def _poses(scene):
    return {image.name: (*image.quat, *image.translation) for image in scene.images}


def _unfinish(run):
    """As a run is that was killed before its first checkpoint."""
    for name in ("metrics.json", "point_cloud.ply"):
        (run / name).unlink()


def _gaussians(run):
    return (run / "point_cloud.ply").read_bytes()


def test_refined_poses_are_what_is_trained_scored_and_shown(
    room, bare, refining, splatseed, tmp_path
):
    run = splatseed("train", bare, *SHORT, "--refine-poses", "-o", tmp_path / "run")
    assert (run.code, run.unexpected) == (0, "")
    assert re.search(r"9\.00 .* 0\.50 px", run.err)
    assert "points of the scene and" in run.err  # triangulated points and auto's
    config = json.loads((tmp_path / "run/config.json").read_text())
    assert (config["scene"], config["refine_poses"]) == (str(bare), True)
    assert config["seeds"]["count"] > 1.2 * len(load_scene(room).points)
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    shown = open_item(moved).scene
    assert _poses(shown) == _poses(load_scene(room))
    assert len(shown.points) == len(load_scene(room).points)
    assert splatseed("evaluate", moved, "-o", tmp_path / "scores.json").code == 0
    scores, trained = (
        json.loads(path.read_text()) for path in (tmp_path / "scores.json", moved / "metrics.json")
    )
    assert scores["psnr"] == pytest.approx(trained["psnr"], abs=1e-3)
    assert scores["scene"] == str(moved / "scene")
    exported = splatseed("export", moved, "-o", tmp_path / "model.spz")
    assert f"--scene {moved / 'scene'}" in exported.out
    again = splatseed("train", "--config", moved / "config.json", "-o", tmp_path / "again")
    assert (again.code, len(refining)) == (0, 2)
    assert _gaussians(moved) == _gaussians(tmp_path / "again")
    assert splatseed("train", room, *SHORT, "--overwrite", "-o", moved).code == 0
    assert not (moved / "scene").exists()


@pytest.fixture
def refused(splatseed):
    """Checks that ``train`` refuses options with one error, which names something."""

    def check(named, *words):
        run = splatseed("train", *words)
        assert (run.code, run.err.count("error:")) == (2, 1)
        assert named in run.err

    return check


def test_a_resumed_run_keeps_its_poses_and_photographs(
    bare, refining, splatseed, refused, tmp_path
):
    run, scene = tmp_path / "run", load_scene(bare, require_points=False)
    assert splatseed("train", bare, *SHORT, "--refine-poses", "-o", run).code == 0
    finished = _gaussians(run)
    _unfinish(run)
    fewer = scene.replace(images=scene.images[1:])
    write_scene(fewer, tmp_path / "fewer", require_points=False)
    refused(str(tmp_path / "fewer"), tmp_path / "fewer", "--resume", "-o", run)
    resumed = splatseed("train", bare, "--resume", "-o", run)
    assert (resumed.code, resumed.unexpected) == (0, "")
    assert len(refining) == 1
    assert _gaussians(run) == finished
    _unfinish(run)
    shutil.rmtree(run / "scene")
    refused(str(run / "scene"), bare, "--resume", "-o", run)


@pytest.fixture
def refinement_of_room(room, monkeypatch):
    """Stands in for pycolmap: returns the room's poses, and 100 points if they are not kept."""

    def stand_in(*, kept):
        truth, change = load_scene(room), Refinement(kept, 0.6, 0.6 if kept else 0.3)

        def call(*arguments):
            assert arguments[-1]  # the scene has points
            points = (
                truth.points.select(slice(0, 0)) if kept else truth.points.select(slice(0, 100))
            )
            images = truth.images
            if not kept:
                images = [replace(i, translation=i.translation + 0.01) for i in images]
            return refined_scene._Refined(tuple(images), points, change)

        monkeypatch.setattr(refined_scene, "call", call)

    return stand_in


def test_points_stay_where_refinement_gains_nothing(room, refinement_of_room, splatseed, tmp_path):
    refinement_of_room(kept=True)
    own, scene = load_scene(room), load_scene(room)
    same, number, (finding,) = refined_scene.refined(own, 0)
    note = str(finding)
    assert (same, number) == (own, len(own.points))
    words = ("--method", "linear", "--ratio", "2", "-o")
    out = splatseed("upsample", room, "--refine-poses", *words, tmp_path / "seeds").err
    assert "Poses and points stay as given" in note
    assert note in out
    seeds = load_scene(tmp_path / "seeds")
    np.testing.assert_array_equal(seeds.points.xyz[: len(scene.points)], scene.points.xyz)
    assert len(seeds.tracks) == len(scene.tracks)
    run, plain = tmp_path / "run", tmp_path / "plain"
    assert note in splatseed("train", room, *SHORT, "--refine-poses", "-o", run).err
    finished = _gaussians(run)
    _unfinish(run)
    assert splatseed("train", room, "--resume", "-o", run).code == 0
    assert splatseed("train", room, *SHORT, "-o", plain).code == 0
    assert _gaussians(run) == finished == _gaussians(plain)


def test_points_that_refinement_replaces_are_announced_first(
    room, refinement_of_room, splatseed, tmp_path
):
    refinement_of_room(kept=False)
    number = len(load_scene(room).points)
    out = splatseed("upsample", room, "--refine-poses", "--method", "linear", "--ratio", "2",
                    "-o", tmp_path / "seeds").err  # fmt: skip
    assert f"100 points, triangulated in place of the scene's {number:,}" in out.split("->")[0]
    assert len(load_scene(tmp_path / "seeds").points) == 200
    out = splatseed("train", room, *SHORT, "--refine-poses", "-o", tmp_path / "run").err
    told = f"The scene's {number:,} points are replaced by 100 triangulated"
    assert told in out.split("->")[0]


def test_points_of_a_scan_stay_in_a_resumed_run_too(
    room, as_by_a_device, monkeypatch, splatseed, tmp_path
):
    truth, run = load_scene(room), tmp_path / "run"
    near = PointCloud(truth.points.xyz[:100] + 0.001, truth.points.rgb[:100])
    found = refined_scene._Refined(truth.images, near, Refinement(False, 9.0, 0.5))
    monkeypatch.setattr(refined_scene, "call", lambda *_: found)
    scanned = as_by_a_device(truth)
    images = tuple(replace(image, observations=None) for image in scanned.images)
    write_scene(scanned.replace(images=images, points=truth.points), tmp_path / "scanned")
    words = (*SHORT, "--seeds", "scene", "--refine-poses", "-o", run)
    out = splatseed("train", tmp_path / "scanned", *words)
    assert (out.code, out.unexpected) == (0, "")
    number = len(truth.points)
    assert f"The scene's {number:,} points stay, beside 100 triangulated" in out.err
    assert "of the scene's own points at the refined poses" in out.err
    np.testing.assert_array_equal(load_scene(run / "scene").points.xyz[:number], truth.points.xyz)
    assert json.loads((run / "config.json").read_text())["seeds"]["count"] == number + 100
    finished = _gaussians(run)
    _unfinish(run)
    assert splatseed("train", tmp_path / "scanned", "--resume", "-o", run).code == 0
    assert _gaussians(run) == finished
    words = ("--refine-poses", "--method", "linear", "--ratio", "2", "-o", tmp_path / "seeds")
    out = splatseed("upsample", tmp_path / "scanned", *words)
    assert f"{number + 100:,} points, 100 of them triangulated" in out.err.split("->")[0]
    np.testing.assert_array_equal(
        load_scene(tmp_path / "seeds").points.xyz[:number], truth.points.xyz
    )


def test_refine_poses_is_refused_on_a_resumed_run_and_on_seeds(
    room, refining, splatseed, refused, tmp_path
):
    run, seeded = tmp_path / "run", tmp_path / "seeded"
    assert splatseed("train", room, *SHORT, "-o", run).code == 0
    _unfinish(run)
    refused("--refine-poses", room, "--refine-poses", "--resume", "-o", run)
    # Seeds would be thrown away.
    assert splatseed("upsample", room, "--method", "linear", "-o", seeded).code == 0
    words = (seeded, *SHORT, "--refine-poses", "-o", tmp_path / "other")
    refused("upsample SCENE --refine-poses -o OUT", *words)
    assert not refining
