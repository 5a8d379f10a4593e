"""One run: its seeds, its result, what is kept, and that it goes on where it stopped."""

from __future__ import annotations

import dataclasses
import json
import os
import signal

import numpy as np
import pytest
from PIL import Image as PilImage

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.bench.planning.plan import plan_runs
from splatseed.bench.planning.scenes import survey
from splatseed.bench.running import job, seeds as seeds_module
from splatseed.bench.running.job import JobOptions, run_job
from splatseed.bench.running.kept import read_result
from splatseed.bench.running.seeds import make_seeds, scene_of
from splatseed.cli import main
from splatseed.io import load_scene, write_scene
from splatseed.process.memory import peak_bytes
from splatseed.synthetic import make_capture
from splatseed.train.seeds import seeds_digest


def with_steps(plan, steps):
    return dataclasses.replace(plan.training, max_steps=steps)


@pytest.fixture
def specs(small_plan, room_path):
    """By method."""
    plan = dataclasses.replace(
        small_plan,
        methods=("sfm", "linear", "depth"),
        repeats=1,
        training=with_steps(small_plan, 20),
    )
    runs = plan_runs(plan, [survey(room_path, "room", with_depth=True)], "cpu", "1")
    return {run.arm.method: run for run in runs}


@pytest.fixture
def do(tmp_path):
    """Does a run in folders of a name."""

    def run(spec, name="a", **options):
        return run_job(spec, tmp_path / "work" / name, tmp_path / "runs" / name, **options)

    return run


def _stop_at(step):
    """Ctrl-C once so many steps are done, as its parent sends it."""

    def progress(stage, fraction):
        if stage == "train" and fraction == pytest.approx(step / 20):
            os.kill(os.getpid(), signal.SIGTERM)

    return progress


def _same(one, other):
    """Whether two results are the same but for times, memory and the number of threads."""
    measured = ("upsample_seconds", "train_seconds", "peak_bytes", "device")
    one, other = (
        dataclasses.replace(
            r,
            **dict.fromkeys(measured, 0),
            curve=tuple(dataclasses.replace(p, seconds=0) for p in r.curve),
            scores=dataclasses.replace(
                r.scores,
                per_image=tuple(dataclasses.replace(v, seconds=0) for v in r.scores.per_image),
            ),
        )
        for r in (one, other)
    )
    return one == other


def test_a_result_says_what_was_measured_and_a_little_is_kept(specs, do, tmp_path):
    outcome = do(specs["linear"])
    assert (outcome.status, outcome.error) == ("done", "")
    result, kept = outcome.result, tmp_path / "runs" / "a"
    metrics = json.loads((kept / "metrics.json").read_text())
    assert result.psnr == metrics["psnr"]
    assert [each.name for each in result.scores.per_image] == [
        v["name"] for v in metrics["per_image"]
    ]
    assert result.psnr == pytest.approx(np.mean([each.psnr for each in result.scores.per_image]))
    assert [point.step for point in result.curve] == list(range(1, 21))
    assert result.num_seeds == 2 * len(load_scene(specs["linear"].scene_path).points)
    assert result.model_bytes == 4 * (3 + 3 + 4 + 1 + 3) * result.num_gaussians
    assert 0 < result.upsample_seconds < 30
    assert 50e6 < result.peak_bytes <= peak_bytes()
    assert result.lpips is None
    assert read_result(kept, specs["linear"].key) == result
    pictures = sorted((kept / "renders").iterdir())
    assert [PilImage.open(path).size for path in pictures] == [(3 * 64 + 8, 48)] * 3
    names = {path.name for path in kept.iterdir()}
    assert names == {"metrics.json", "config.json", "curve.csv", "result.json", "renders",
                     "splatseed.json"}  # fmt: skip
    assert not (tmp_path / "work" / "a").exists()


def test_the_scenes_own_test_images_are_scored(small_plan, own_room, do):
    names = sorted(image.name for image in load_scene(own_room).images)
    (own_room / "test_list.txt").write_text("\n".join(names[1:3]))
    plan = dataclasses.replace(small_plan, repeats=1, training=with_steps(small_plan, 1))
    (spec, *_) = plan_runs(plan, [survey(own_room, "room")], "cpu", "1")
    outcome = do(spec)
    assert [each.name for each in outcome.result.scores.per_image] == names[1:3]


def test_models_are_kept_on_request(specs, do, tmp_path):
    assert do(specs["sfm"], options=JobOptions(keep_models=True)).status == "done"
    assert (tmp_path / "runs" / "a" / "point_cloud.ply").stat().st_size > 1000


@pytest.mark.parametrize("method", ["sfm", "linear", "depth"])
def test_seeds_are_those_that_the_command_writes(specs, own_room, tmp_path, method):
    """Also where the cloud has points that are not finite, or twice at one place."""
    scene = load_scene(own_room)
    xyz = scene.points.xyz.copy()
    xyz[3], xyz[5] = np.nan, xyz[6]
    spoilt = tmp_path / "spoilt"
    write_scene(scene, spoilt)
    from splatseed.io.ply import write_ply

    for path in (spoilt / "sparse" / "0").glob("points3D.*"):
        path.unlink()
    write_ply(spoilt / "sparse" / "0" / "points3D.ply", scene.points.replace(xyz=xyz))
    spec = dataclasses.replace(specs[method], scene_path=str(spoilt))
    seeds, seconds = make_seeds(scene_of(spec), spec)
    ratio = "1" if method == "sfm" else "2"
    words = ["--method", "linear"] if method == "sfm" else ["--method", method]
    words += ["--depth", str(spec.depth_path), "--depth.hold-out", "4"] * (method == "depth")
    main(["upsample", str(spoilt), "-o", str(tmp_path / "out"), "--ratio", ratio, *words])
    written = load_scene(tmp_path / "out").points
    assert seeds_digest(seeds) == seeds_digest(written)
    assert len(seeds) == int(ratio) * (len(xyz) - 2)
    assert (seconds == 0.0) == (method == "sfm")


@pytest.mark.parametrize("method", ["cloud", "cloud+cover"])
def test_seeds_from_a_scan_are_those_that_the_command_writes(
    small_plan, room_path, tmp_path, method
):
    scan, out = tmp_path / "scan.npz", tmp_path / "out"
    surfaces = make_capture(0, 3, 32, 32).surfaces
    np.savez(scan, xyz=surfaces.sample(20_000, np.random.default_rng(2)))
    plan = dataclasses.replace(small_plan, methods=(method,), repeats=1)
    (spec,) = plan_runs(plan, [survey(room_path, "room", cloud=scan)], "cpu", "1")
    first, seconds = make_seeds(scene_of(spec), spec, bench=tmp_path)
    again, known = make_seeds(scene_of(spec), spec, bench=tmp_path)
    assert seeds_digest(first) == seeds_digest(again)
    assert min(seconds, known) > 0
    words = ["--method", method.removeprefix("cloud+"), "--cloud.hold-out", "4"]
    words += ["--cover.hold-out", "4"] * (method != "cloud")
    main(["upsample", str(room_path), "--cloud", str(scan), "-o", str(out), *words])
    written = load_scene(out).points
    np.testing.assert_array_equal(first.xyz, written.xyz)
    np.testing.assert_array_equal(first.rgb, written.rgb)


def test_an_interrupted_run_goes_on_to_the_same_result(specs, do, tmp_path):
    straight = do(specs["linear"], "straight")
    assert do(specs["linear"], progress=_stop_at(7)).status == "interrupted"
    assert (tmp_path / "work" / "a" / "checkpoint.pt").is_file()
    assert not (tmp_path / "runs" / "a").exists()
    steps = []
    resumed = do(
        specs["linear"], progress=lambda stage, f: stage == "train" and steps.append(f * 20)
    )
    assert min(steps) == pytest.approx(8)
    assert _same(resumed.result, straight.result)


def test_a_damaged_checkpoint_means_to_begin_anew(specs, do, tmp_path):
    assert do(specs["sfm"], progress=_stop_at(7)).status == "interrupted"
    (tmp_path / "work" / "a" / "checkpoint.pt").write_bytes(b"damaged")
    steps = []
    progress = lambda stage, f: stage == "train" and steps.append(f * 20)
    assert do(specs["sfm"], progress=progress).status == "done"
    assert min(steps) == pytest.approx(1)


def test_what_is_kept_is_not_made_again(specs, do, monkeypatch):
    first = do(specs["sfm"])
    monkeypatch.setattr(job, "_train", lambda *_: pytest.fail("trained again"))
    assert do(specs["sfm"]) == first


def test_leftovers_of_a_killed_attempt_go(specs, do, tmp_path):
    left = tmp_path / "runs" / ".a.partial-0123abcd"
    left.mkdir(parents=True)
    (left / "half").write_text("half")
    assert do(specs["sfm"]).status == "done"
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["a"]


def test_a_scene_that_has_changed_is_an_error_that_is_kept(specs, do, own_room, tmp_path):
    spec = dataclasses.replace(specs["sfm"], scene_path=str(own_room))
    photograph = next((own_room / "images").iterdir())
    photograph.write_bytes(photograph.read_bytes() + b"\0")
    outcome = do(spec)
    assert outcome.status == "failed"
    assert "as they were when the benchmark was planned" in outcome.error
    assert "\n" not in outcome.error
    error = (tmp_path / "runs" / "a" / "error.txt").read_text()
    assert "Traceback" in error
    assert "_check_unchanged" in error
    assert do(specs["sfm"]).status == "done"  # and its success takes the place of the error
    assert not (tmp_path / "runs" / "a" / "error.txt").exists()


def test_a_bug_is_one_line_too(specs, do, monkeypatch):
    def bug(*_):
        raise ZeroDivisionError("two\nlines")

    monkeypatch.setattr(job, "scene_of", bug)
    assert do(specs["sfm"]).error == "ZeroDivisionError: two lines"


def test_files_of_the_users_are_left_alone(specs, do, tmp_path):
    mine = tmp_path / "runs" / "a" / "thesis.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("keep")
    outcome = do(specs["sfm"])
    assert outcome.status == "failed"
    assert "did not write" in outcome.error
    assert [path.name for path in mine.parent.iterdir()] == ["thesis.txt"]


@pytest.fixture
def budgeted(small_plan, room_path):
    """Runs under a budget below the room's points, by method."""
    plan = dataclasses.replace(
        small_plan, methods=("sfm", "linear", "auto"), ratios=(), budgets=(60,), repeats=1
    )
    runs = plan_runs(plan, [survey(room_path, "room")], "cpu", "1")
    return {run.arm.method: run for run in runs}


def test_seeds_are_thinned_to_the_budget_and_equal_seeds_are_trained_once(
    budgeted, do, tmp_path, monkeypatch
):
    first = _as_kept(do, budgeted["sfm"])
    assert (first.status, first.error) == ("done", "")
    assert first.result.num_seeds == first.result.num_gaussians == 60
    assert first.result.upsample_seconds > 0
    monkeypatch.setattr(job, "_prepare", lambda *_: pytest.fail("trained again"))
    for method in ("linear", "auto"):
        twin = _as_kept(do, budgeted[method]).result
        assert twin.twin == budgeted["sfm"].key
        assert (twin.scores, twin.curve) == (first.result.scores, first.result.curve)
        kept = tmp_path / "runs" / budgeted[method].key
        assert read_result(kept, budgeted[method].key) == twin
        assert len(list((kept / "renders").iterdir())) == 3
    monkeypatch.undo()
    other = _as_kept(do, dataclasses.replace(budgeted["linear"], repeat=1)).result
    assert other.twin == ""  # another seed of training


def _as_kept(do, spec):
    """A run in the folder of its key, as executors have it."""
    return do(spec, spec.key)


def test_a_method_fills_the_budget(budgeted, room_path):
    roomy = dataclasses.replace(
        budgeted["linear"],
        training=dataclasses.replace(budgeted["linear"].training, cap_max=9000),
        arm=dataclasses.replace(budgeted["linear"].arm, budget="9000", strategy="default"),
    )
    seeds, _ = make_seeds(scene_of(roomy), roomy)
    assert len(seeds) == roomy.most_seeds == 6300  # what default begins with, of 9,000


def test_pixels_that_two_training_views_see_are_found_once(specs, do, tmp_path):
    result = do(specs["sfm"]).result
    (kept,) = (tmp_path / "covisible").iterdir()
    assert 0.3 < result.scores.covisible_share <= 1
    assert all(view.covisible_psnr is not None for view in result.scores.per_image)
    from splatseed.splat.covisible import read_covisible, write_covisible

    grids = read_covisible(kept)
    assert set(grids) == {view.name for view in result.scores.per_image}
    write_covisible(kept, {name: np.zeros_like(grid) for name, grid in grids.items()})
    blind = do(specs["depth"], "depth").result  # another arm takes what is kept
    assert blind.scores.covisible_share == 0
    assert blind.scores.covisible_psnr is None


def test_points_of_photographs_are_made_once_for_all_budgets(budgeted, tmp_path, monkeypatch):
    """And are those that a run without the kept ones begins with."""
    spec = budgeted["auto"]
    roomy = dataclasses.replace(
        spec, training=dataclasses.replace(spec.training, cap_max=3000),
        arm=dataclasses.replace(spec.arm, budget="3000"),
    )  # fmt: skip
    scene = scene_of(roomy)
    plain, _ = make_seeds(scene, roomy)
    first, seconds = make_seeds(scene, roomy, bench=tmp_path)
    assert seeds_digest(first) == seeds_digest(plain)
    made = []
    monkeypatch.setattr(seeds_module, "upsample", lambda *_, **__: made.append(1))
    again, later = make_seeds(scene, roomy, bench=tmp_path)
    assert seeds_digest(again) == seeds_digest(plain)
    assert later > 0.3 * seconds
    assert not made
