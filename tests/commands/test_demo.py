"""``splatseed demo``: scenes, scores, pictures and runs."""

from __future__ import annotations

import csv
import json

import numpy as np
import pycolmap
import pytest
from PIL import Image as PilImage

pytest.importorskip("gsplat", reason="training needs PyTorch and gsplat's strategies")

import splatseed.training.run  # noqa: F401  (loaded, its curves are drawn once for all tests)
from splatseed import synthetic
from splatseed.commands import demo
from splatseed.errors import MissingDependencyError
from splatseed.io import load_scene
from splatseed.methods import METHODS
from splatseed.progress import notify
from splatseed.synthetic import write_capture


@pytest.fixture(autouse=True)
def quick(rooms_are_small, monkeypatch):
    monkeypatch.setattr(demo, "RATIO", 2.0)


@pytest.mark.slow
def test_the_demo_leaves_a_scene_scores_pictures_and_runs(tmp_path, splatseed):
    out = tmp_path / "demo"
    run = splatseed("demo", "--views", 6, "--train-steps", 12, "-o", out)
    assert run.code == 0, run
    for name in ("preview.png", "preview_methods.png", "preview_errors.png", "preview_trained.png"):
        assert str(out / name) in run.out
        with PilImage.open(out / name) as picture:
            assert np.ptp(np.asarray(picture.convert("RGB")), axis=2).max() > 50
    with (out / "geometry.csv").open(newline="", encoding="utf-8") as file:
        scores = {row.pop("method"): row for row in csv.DictReader(file)}
    assert set(scores) == {"originals", *METHODS} - {"cloud"}  # which needs a scan
    # What any upsampling is for, and what strewing points at random does not give.
    assert float(scores["mls"]["coverage_h"]) < float(scores["originals"]["coverage_h"])
    assert float(scores["mls"]["error_h"]) < float(scores["random"]["error_h"])
    assert pycolmap.Reconstruction(out / "scene/sparse/0").num_images() == 6
    before, after = load_scene(out / "scene"), load_scene(out / "scene_auto")
    assert len(after.points) > 2 * len(before.points)
    assert not before.findings
    assert after.points.num_original == len(before.points)
    metrics = {}
    for name in ("random", "poses", "sfm"):
        metrics[name] = json.loads((out / f"run_{name}/metrics.json").read_text())
        config = json.loads((out / f"run_{name}/config.json").read_text())
        assert (config["strategy"], config["backend"]) == ("default", "cpu")
        # A random start also has steps for the seconds that seeds take.
        assert (metrics[name]["steps"] > 12) == (name == "random")
        assert config["cap_max"] == len(after.points)
        assert f"{metrics[name]['psnr']:.2f}" in run.out
    gain = metrics["poses"]["psnr"] - metrics["random"]["psnr"]
    gained = "gain" if gain > 0 else "gain nothing: they lose"
    assert f"without points, {gained} {abs(gain):.2f} dB" in run.out
    alone = load_scene(out / "scene_poses").points
    assert not alone.num_original  # no point of the scene was known
    assert len(load_scene(out / "scene_random").points) == 100_000
    # What the demo says to run next works: its runs know their scenes by where they lie now.
    again = splatseed("evaluate", out / "run_poses")
    assert again.code == 0, again
    assert f"{metrics['poses']['psnr']:.2f}" in again.out
    assert f"splatseed export {out / 'run_poses'} -o model.html" in run.out


def test_without_pytorch_the_demo_does_not_train(splatseed, tmp_path, monkeypatch):
    def absent(*_):
        raise MissingDependencyError("the packages", found="no torch", fix="Install them.")

    monkeypatch.setattr(demo, "require", absent)
    monkeypatch.setattr(demo, "methods_for", lambda _: ("auto", "linear"))
    run = splatseed("demo", "--views", 4, "--train-steps", 9, "-o", tmp_path / "demo")
    assert run.code == 0, run
    assert "not trained: no torch installed" in run.err
    assert "splatseed evaluate" not in run.out
    rest = f"splatseed demo -o {tmp_path / 'demo'} --training only --train-steps 9"
    assert rest in run.out
    assert "splatseed export" not in run.out
    assert not (tmp_path / "demo" / "run_sfm").exists()
    assert (tmp_path / "demo" / "geometry.csv").is_file()


def test_the_compiling_process_starts_with_the_first_compilation_and_ends(monkeypatch):
    children = []

    class Child(demo.Child):
        def __init__(self, *call, **options):
            super().__init__(*call, **options)
            children.append(self)

    monkeypatch.setattr(demo, "Child", Child)
    with demo.compiled_ahead([]) as finish:
        assert not children
        for begins in (True, False, True):
            notify(begins)
        (child,) = children
        finish()  # a small capture is made, and nothing else
    assert child.process.poll() is not None


def test_the_compiling_process_runs_a_small_demo(tmp_path):
    """A failure there would go unseen: the demo would compile by itself, and be slow."""
    write_capture(synthetic.make_capture(demo.SEED, **demo.SMALL), tmp_path / "scene")
    for part in demo.AHEAD:
        demo._compile(part, demo._load(tmp_path), tmp_path)
