"""``splatseed train --refine-poses``: what is done before it trains."""

from __future__ import annotations

import json
import shutil

import pytest

from splatseed.io import load_scene, write_scene
from splatseed.sfm import Refinement, SfmReport

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.view.models import open_shown

SHORT = ("--max-steps", "3", "--data-factor", "2")
ENDED = ("metrics.json", "point_cloud.ply")


@pytest.fixture
def refining(room, monkeypatch):
    """Stands in for pycolmap: poses and points are the room's. Its list tells the calls."""
    truth, calls = load_scene(room), []

    def reconstruct(folder, output, settings, **how):
        assert how["refine_poses"]
        calls.append(folder)
        write_scene(truth, output)
        change = Refinement(False, 9.0, 0.5, 0.1, 0.2, 0.1, 0.2)
        return SfmReport(output, 12, 12, (), len(truth.points), 3.0, 0.5, {}, change)

    monkeypatch.setattr("splatseed.sfm.pipeline.reconstruct", reconstruct)
    return calls


@pytest.fixture
def bare(room, as_by_a_device, tmp_path):
    """The room with poses that are off, and no points."""
    write_scene(as_by_a_device(load_scene(room)), tmp_path / "bare", require_points=False)
    return tmp_path / "bare"


def _contents(folder):
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _poses(scene):
    return {image.name: (*image.quat, *image.translation) for image in scene.images}


def _unfinish(run):
    """As a run is that was killed before its first checkpoint."""
    for name in ENDED:
        (run / name).unlink()


def test_refined_poses_are_what_is_trained_scored_and_shown(
    room, bare, refining, splatseed, tmp_path
):
    before = _contents(bare)
    run = splatseed("train", bare, *SHORT, "--refine-poses", "-o", tmp_path / "run")
    assert (run.code, run.err) == (0, "")
    assert "note: Refined poses lower the mean reprojection error from 9.00 to 0.50 px" in run.out
    assert "Seeds by method auto: " in run.out
    assert _contents(bare) == before
    config = json.loads((tmp_path / "run/config.json").read_text())
    assert (config["scene"], config["refine_poses"]) == (str(bare), True)
    moved = (tmp_path / "run").rename(tmp_path / "moved")
    shown = open_shown(moved).scene
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
    assert _same_gaussians(moved, tmp_path / "again")
    assert splatseed("train", room, *SHORT, "--overwrite", "-o", moved).code == 0
    assert not (moved / "scene").exists()


def _same_gaussians(first, second):
    one, other = ((run / "point_cloud.ply").read_bytes() for run in (first, second))
    return one == other


@pytest.mark.parametrize("named", [(), ("--refine-poses",)])
def test_a_run_goes_on_at_the_poses_that_it_began_with(named, bare, refining, splatseed, tmp_path):
    run = tmp_path / "run"
    assert splatseed("train", bare, *SHORT, "--refine-poses", "-o", run).code == 0
    kept = shutil.copytree(run, tmp_path / "kept", symlinks=True)
    _unfinish(run)
    resumed = splatseed("train", bare, *named, "--resume", "-o", run)
    assert (resumed.code, resumed.err) == (0, "")
    assert len(refining) == 1
    assert _same_gaussians(run, kept)


def test_a_run_that_lost_its_poses_or_its_photographs_does_not_go_on(
    bare, refining, splatseed, tmp_path
):
    run = tmp_path / "run"
    assert splatseed("train", bare, *SHORT, "--refine-poses", "-o", run).code == 0
    _unfinish(run)
    scene = load_scene(bare, require_points=False)
    fewer = scene.replace(images=scene.images[1:])
    write_scene(fewer, tmp_path / "fewer", require_points=False)
    other = splatseed("train", tmp_path / "fewer", "--resume", "-o", run)
    assert (other.code, other.err.count("error:")) == (2, 1)
    assert f"found other images in {tmp_path / 'fewer'}" in other.err
    shutil.rmtree(run / "scene")
    lost = splatseed("train", bare, "--resume", "-o", run)
    assert (lost.code, lost.err.count("error:")) == (2, 1)
    assert str(run / "scene") in lost.err


def test_a_run_that_began_without_does_not_go_on_with_it(room, splatseed, tmp_path):
    run = tmp_path / "run"
    assert splatseed("train", room, *SHORT, "-o", run).code == 0
    _unfinish(run)
    resumed = splatseed("train", room, "--refine-poses", "--resume", "-o", run)
    assert (resumed.code, resumed.err.count("error:")) == (2, 1)
    assert "--refine-poses False, as when the run began" in resumed.err


def test_seeds_are_not_thrown_away(room, refining, splatseed, tmp_path):
    assert splatseed("upsample", room, "--method", "linear", "-o", tmp_path / "seeded").code == 0
    words = (*SHORT, "--refine-poses", "-o", tmp_path / "run")
    run = splatseed("train", tmp_path / "seeded", *words)
    assert (run.code, run.err.count("error:")) == (2, 1)
    assert "upsample SCENE --refine-poses -o OUT" in run.err
    assert not refining


def test_those_who_watch_see_the_refined_cameras(
    room, bare, refining, splatseed, tmp_path, monkeypatch
):
    pytest.importorskip("viser", reason="watching needs viser")
    watched = []

    class Viewer:
        kept = False

        def __init__(self, training, scene, *_):
            watched.append(scene)

        def on_step(self, step):
            pass

        def close(self):
            pass

    monkeypatch.setattr("splatseed.view.server.TrainingViewer", Viewer)
    words = (*SHORT, "--refine-poses", "--view", "-o", tmp_path / "run")
    assert splatseed("train", bare, *words).code == 0
    assert _poses(watched[0]) == _poses(load_scene(room))


def test_poses_are_refined_by_pycolmap(sharp_bare, splatseed, tmp_path):
    pytest.importorskip("pycolmap", reason="poses are refined by pycolmap")
    words = ("--max-steps", "3", "--data-factor", "4", "--refine-poses", "-o", tmp_path / "run")
    run = splatseed("train", sharp_bare, *words)
    assert run.code == 0, run.err
    assert "note: Refined poses lower the mean reprojection error from" in run.out
    scene = load_scene(tmp_path / "run/scene")
    assert _poses(scene) != _poses(load_scene(sharp_bare, require_points=False))
    assert len(scene.points) > 100
