"""One run: its seeds, its result, its folder; runs that fail, die, or are elsewhere."""

from __future__ import annotations

import dataclasses
import json
import tempfile

import numpy as np
import pytest
from PIL import Image as PilImage

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.bench.job import (
    Machine,
    RunOptions,
    execute_runs,
    local_machine,
    make_seeds,
    open_unchanged,
    run_job,
    run_remotely,
)
from splatseed.bench.plan import plan_runs
from splatseed.bench.runs import read_run, run_folder
from splatseed.cli import main
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.ply import write_ply
from splatseed.splat.covisible import read_covisible
from splatseed.splat.pictures import BAND
from splatseed.training.seeds import seeds_digest

from .planted import surveyed


@pytest.fixture
def specs(small_plan, room_path):
    """By method."""
    plan = dataclasses.replace(
        small_plan,
        methods=("sfm", "linear", "depth"),
        repeats=1,
        training=dataclasses.replace(small_plan.training, max_steps=4),
    )
    facts = surveyed(room_path, with_depth=True)
    runs = plan_runs(plan, [facts], "cpu")
    return {run.arm.method: run for run in runs}


@pytest.mark.usefixtures("score_often")
def test_a_result_says_what_was_measured_and_a_little_is_kept(specs, tmp_path):
    spec = specs["linear"]
    result = run_job(spec, RunOptions(), tmp_path)
    kept = run_folder(tmp_path, spec)
    metrics = json.loads((kept / "metrics.json").read_text())
    assert result.psnr == metrics["psnr"]
    assert result.psnr == pytest.approx(np.mean([each.psnr for each in result.scores.per_image]))
    assert [point.step for point in result.curve] == [1, 2, 3, 4]
    assert result.num_seeds == 2 * len(load_scene(spec.scene.path).points)
    assert result.scores.model_bytes == 4 * (3 + 3 + 4 + 1 + 3) * result.num_gaussians
    assert 0 < result.upsample_seconds < result.wall_seconds
    assert result.peak_bytes > 50e6
    assert read_run(tmp_path, spec).result == result
    pictures = sorted((kept / "renders").iterdir())
    assert [PilImage.open(path).size for path in pictures] == [(3 * 64 + 8, 48 + BAND)]
    seen = read_covisible(next((tmp_path / "covisible").iterdir()))
    assert set(seen) == {view.name for view in result.scores.per_image}
    assert 0.3 < result.scores.covisible_share <= 1
    assert not (kept / "point_cloud.ply").exists()
    run_job(spec, RunOptions(keep_models=True), tmp_path)
    assert (kept / "point_cloud.ply").stat().st_size > 1000


def here(workers, *, remote=False):
    return Machine("cpu", workers.jobs, 1, workers, remote)


def _moved(spec, **changes):
    return dataclasses.replace(spec, scene=dataclasses.replace(spec.scene, **changes))


COMMANDS = {
    "sfm": ["--method", "linear", "--ratio", "1"],
    "linear": ["--method", "linear", "--ratio", "2"],
    "depth": ["--method", "depth", "--ratio", "2", "--depth", "DEPTH", "--depth.test-every", "4"],
    "cloud": ["--method", "cloud", "--cloud", "SCAN", "--cloud.test-every", "4"],
    "cloud+cover": ["--method", "cover", "--cloud", "SCAN", "--cloud.test-every", "4",
                    "--cover.test-every", "4"],
}  # fmt: skip


@pytest.mark.parametrize("method", COMMANDS)
def test_seeds_are_those_that_the_command_writes(small_plan, own_room, room_of, tmp_path, method):
    """Also where the cloud has points that are not finite, or twice at one place."""
    points, model = load_scene(own_room).points, own_room / "sparse" / "0"
    xyz = points.xyz.copy()
    xyz[3], xyz[5] = np.nan, xyz[6]
    for path in model.glob("points3D.*"):
        path.unlink()
    write_ply(model / "points3D.ply", points.replace(xyz=xyz))
    scan, surfaces = tmp_path / "scan.npz", room_of(9, 64, 48).capture.surfaces
    np.savez(scan, xyz=surfaces.sample(20_000, np.random.default_rng(2)))
    facts = surveyed(own_room, cloud=scan, with_depth=True)
    plan = dataclasses.replace(small_plan, methods=(method,), repeats=1)
    (spec,) = plan_runs(plan, [facts], "cpu")
    seeds, seconds = make_seeds(open_unchanged(spec.scene), spec)
    files = {"DEPTH": spec.scene.depth, "SCAN": str(scan)}
    words = [files.get(word, word) for word in COMMANDS[method]]
    main(["upsample", str(own_room), "-o", str(tmp_path / "out"), *words])
    written = load_scene(tmp_path / "out").points
    np.testing.assert_array_equal(seeds.xyz, written.xyz)
    np.testing.assert_array_equal(seeds.rgb, written.rgb)
    assert (seconds == 0.0) == (method == "sfm")
    assert "cloud" in method or len(seeds) == (1 + (method != "sfm")) * (len(xyz) - 2)


def _budgeted(small_plan, room_path, method, budget, strategy="none"):
    plan = dataclasses.replace(
        small_plan, methods=(method,), ratios=(), budgets=(budget,), repeats=1,
        strategies=(strategy,),
    )  # fmt: skip
    (spec,) = plan_runs(plan, [surveyed(room_path)], "cpu")
    return spec


def test_seeds_are_thinned_to_the_budget_or_fill_it(small_plan, room_path):
    for method, budget, strategy, number in (
        ("sfm", 60, "none", 60), ("linear", 60, "none", 60), ("auto", 60, "none", 60),
        ("linear", 9000, "default", 6300),  # what default begins with, of 9,000
    ):  # fmt: skip
        spec = _budgeted(small_plan, room_path, method, budget, strategy)
        seeds, _ = make_seeds(open_unchanged(spec.scene), spec)
        assert len(seeds) == spec.max_seeds == number


def test_points_of_photographs_are_made_once_for_all_budgets(
    small_plan, room_path, tmp_path, monkeypatch
):
    """And are those that a run without the kept ones begins with."""
    spec = _budgeted(small_plan, room_path, "auto", 3000)
    scene = open_unchanged(spec.scene)
    plain, _ = make_seeds(scene, spec)
    first, seconds = make_seeds(scene, spec, bench=tmp_path)
    assert seeds_digest(first) == seeds_digest(plain)
    monkeypatch.setattr(
        "splatseed.seeding.upsampling.upsample", lambda *_, **__: pytest.fail("made again")
    )
    again, later = make_seeds(scene, spec, bench=tmp_path)
    assert seeds_digest(again) == seeds_digest(plain)
    assert later > 0.3 * seconds


def test_a_scene_that_has_changed_fails_its_run_alone_and_is_recorded(
    specs, own_room, tmp_path, in_process
):
    broken = _moved(specs["sfm"], path=str(own_room))
    photograph = next((own_room / "images").iterdir())
    photograph.write_bytes(photograph.read_bytes() + b"\0")
    todo = [broken, specs["linear"]]
    failed, done = execute_runs(tmp_path, todo, here(in_process), RunOptions())
    assert "as they were when the benchmark was planned" in failed.error
    assert "\n" not in failed.error
    assert done.result is not None
    assert read_run(tmp_path, broken) == failed
    error = json.loads((run_folder(tmp_path, broken) / "error.json").read_text())
    assert "open_unchanged" in error["traceback"]
    (done,) = execute_runs(tmp_path, [specs["sfm"]], here(in_process), RunOptions())
    assert read_run(tmp_path, broken).result == done.result  # which takes the error's place


def test_processes_get_the_threads_that_the_user_allows(monkeypatch):
    monkeypatch.setattr("splatseed.progress.available_cpus", lambda: 8)
    monkeypatch.setenv("OMP_NUM_THREADS", "")
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")
    for jobs, threads in ((1, 3), (4, 2)):
        machine = local_machine(jobs, "cpu")
        assert machine.threads == threads
        environment = machine.workers._free.get()
        assert environment["OMP_NUM_THREADS"] == environment["NUMBA_NUM_THREADS"] == f"{threads}"


def test_code_that_changed_since_the_plan_makes_no_run(specs, tmp_path):
    for changed in ({"version": "0.0.1"}, {"method_version": "1.0+0123456789ab"}):
        spec = dataclasses.replace(specs["linear"], **changed)
        with pytest.raises(ParameterError, match="as it was when the benchmark was planned"):
            run_job(spec, RunOptions(), tmp_path)
    assert not (tmp_path / "runs").exists()


def test_files_of_the_users_are_left_alone(specs, tmp_path, in_process):
    mine = run_folder(tmp_path, specs["sfm"]) / "thesis.txt"
    mine.parent.mkdir(parents=True)
    mine.write_text("keep")
    (failed,) = execute_runs(tmp_path, [specs["sfm"]], here(in_process), RunOptions())
    assert mine.parent.name in failed.error
    assert [path.name for path in mine.parent.iterdir()] == ["thesis.txt"]


def test_a_run_elsewhere_comes_back_as_files_and_leaves_nothing(
    specs, tmp_path, monkeypatch, in_process
):
    nodes = tmp_path / "nodes"
    nodes.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(nodes))
    (run,) = execute_runs(tmp_path, [specs["sfm"]], here(in_process, remote=True), RunOptions())
    assert read_run(tmp_path, specs["sfm"]) == run
    assert list(nodes.iterdir()) == []
    far = _moved(specs["sfm"], path="elsewhere/room")
    with pytest.raises(SceneNotFoundError, match="elsewhere/room"):
        run_remotely(far, RunOptions())
    with pytest.raises(ParameterError, match=r"0\.0\.1"):
        run_remotely(dataclasses.replace(specs["sfm"], version="0.0.1"), RunOptions())
