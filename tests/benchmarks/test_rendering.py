"""The benchmarks of rendering and training: that they measure what they say, at a tiny size."""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from splatseed.io import load_scene
from splatseed.splat.formats import read_gaussians

MODULES = (
    "rendering.splats", "common.children", "common.clocks", "rendering.stopwatch",
    "rendering.torch_rasterizer", "rendering.opensplat", "rendering.render", "rendering.train_step",
)  # fmt: skip


@pytest.fixture(scope="module")
def workload(bench):
    return bench.splats.make_workload(1_500, 64, 48)


@pytest.fixture
def scene_file(workload, tmp_path):
    workload.save(tmp_path / "scene.npz")
    return str(tmp_path / "scene.npz")


def test_a_workload_is_the_same_each_time_and_survives_its_file(bench, workload, scene_file):
    again = bench.splats.make_workload(1_500, 64, 48)
    read = bench.splats.Workload.load(Path(scene_file))
    for other in (again, read):
        for name, array in workload.gaussians.arrays().items():
            np.testing.assert_array_equal(array, other.gaussians.arrays()[name])
        for view, twin in zip(workload.views, other.views, strict=True):
            assert (view.name, view.width, view.height) == (twin.name, twin.width, twin.height)
            np.testing.assert_array_equal(view.photograph, twin.photograph)
            np.testing.assert_array_equal(view.cam_from_world, twin.cam_from_world)


def test_useful_pairs_are_those_that_add_to_a_pixel(bench, rng):
    num, width, height = 60, 19, 13
    means2d = rng.uniform(-3, 22, (num, 2))
    factor = rng.normal(size=(num, 2, 2)) * rng.uniform(0.5, 5, (num, 1, 1))
    inverse = np.linalg.inv(factor @ factor.transpose(0, 2, 1) + 0.3 * np.eye(2))
    conics = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1)
    opacities, depths = rng.uniform(0.001, 1, num), rng.uniform(1, 9, num)
    drawn = rng.random(num) < 0.9
    expected = sum(
        _pairs_of_pixel(means2d, inverse, opacities, depths, drawn, np.array([x, y]) + 0.5)
        for y in range(height)
        for x in range(width)
    )
    arrays = [each.astype(np.float32) for each in (means2d, conics, opacities, depths)]
    assert bench.splats.useful_pairs(*arrays, drawn, width, height) == expected


def _pairs_of_pixel(means2d, inverse, opacities, depths, drawn, pixel):
    count, passing = 0, 1.0
    for g in np.argsort(depths):
        d = means2d[g] - pixel
        alpha = min(0.999, opacities[g] * np.exp(-0.5 * d @ inverse[g] @ d))
        if not drawn[g] or alpha < 1 / 255:
            continue
        if passing * (1 - alpha) <= 1e-4:
            break
        passing *= 1 - alpha
        count += 1
    return count


def test_the_peer_in_pytorch_draws_the_same_picture_with_the_same_gradients(bench, workload):
    renders = {}
    both = {"peer": bench.torch_rasterizer.rasterize, "ours": bench.render.rasterization}
    for name, rasterize in both.items():
        inputs = bench.render._inputs(workload)
        image, alphas, _ = rasterize(**inputs)
        weights = torch.from_numpy(np.random.default_rng(2).normal(size=(1, 48, 64, 4))).float()
        (torch.cat([image, alphas], dim=-1) * weights).sum().backward()
        leaves = {key: inputs[key] for key in ("means", "quats", "scales", "opacities")}
        leaves |= {"sh0": inputs["colors"][0], "shN": inputs["colors"][1]}
        renders[name] = {key: leaf.grad for key, leaf in leaves.items()} | {"image": image.detach()}
    for key, ours in renders["ours"].items():
        gap = (ours - renders["peer"][key]).abs() / ours.abs().max()
        # In single precision a pixel or two fall on the other side of a cut-off.
        assert (gap > 1e-4).float().mean() < 2e-3, key


def test_a_render_is_measured_stage_by_stage(bench, scene_file):
    measured = bench.render.measure(scene_file, 2, "wall")
    seconds = measured["seconds"]
    rests = {"rest", "rest backward", "forward", "backward"}
    assert set(seconds) == {*bench.stopwatch.RENDER_STAGES} | rests
    assert all(value > 0 for value in seconds.values())
    run = bench.render.Run("this", 1, measured["pairs"], seconds)
    assert 20 < run.pairs / (64 * 48) < 80
    assert run.rate("blend kernel") > run.rate("blend kernel", "blend layout")
    assert run.milliseconds("whole", "forward") > run.milliseconds("blend kernel", "forward")


@pytest.mark.parametrize("clock", ["wall", "cpu"])
def test_a_training_step_is_measured_part_by_part(bench, scene_file, clock):
    if clock == "cpu" and sys.platform != "linux":
        pytest.skip("threads have clocks of their own on Linux")
    measured = bench.train_step.measure(scene_file, 3, clock)
    assert len(measured["laps"]) == 3
    stages = {stage for pair in bench.train_step.PARTS.values() for stage in pair if stage}
    for lap in measured["laps"]:
        assert set(lap) == stages | {"whole"}
        assert sum(lap[stage] for stage in stages) == pytest.approx(lap["whole"])
    assert 20 < measured["pairs"] < 80


def test_time_counts_once_and_functions_are_put_back(bench, monkeypatch):
    def outer():
        owner.inner()

    clock = iter(range(10))
    fake = SimpleNamespace(perf_counter=lambda: next(clock))
    monkeypatch.setattr(bench.clocks, "time", fake)
    owner = SimpleNamespace(inner=int, outer=outer)
    before = dict(vars(owner))
    with bench.stopwatch.timed({"a": [(owner, "outer")], "b": [(owner, "inner")]}) as watch:
        owner.outer()
        # a runs from 0 to 3, b within it from 1 to 2
        assert watch.lap() == {"a": 2, "b": 1}
    assert vars(owner) == before


def test_a_child_has_its_threads_and_says_what_went_wrong(bench):
    assert bench.children.call("os:getenv", threads=3, key="NUMBA_NUM_THREADS") == "3"
    with pytest.raises(bench.children.ChildError, match="TypeError"):
        bench.children.call("os:getenv", threads=1, no_such=1)


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="programs are held to cores")
def test_opensplat_gets_our_scene_and_its_start_is_left_out(bench, workload, tmp_path, monkeypatch):
    """The stand-in keeps its inputs; its clock says 7 seconds to start and 0.05 a step."""
    program, kept = tmp_path / "opensplat", tmp_path / "kept"
    program.write_text(
        f"""#!{sys.executable}
import os, shutil, sys
assert len(os.sched_getaffinity(0)) == 1, "more cores than asked for"
shutil.copytree(sys.argv[1], {str(kept)!r}, dirs_exist_ok=True)
shutil.copy(sys.argv[1 + sys.argv[1:].index("--resume") + 1], {str(kept / "gaussians.ply")!r})
"""
    )
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    run, cores = bench.opensplat._seconds, os.sched_getaffinity(0)

    def pretend(command, threads, clock):
        assert run(command, threads, clock) > 0
        return 7 + 0.05 * (int(command[command.index("-n") + 1]) - 3000)

    monkeypatch.setattr(bench.opensplat, "_seconds", pretend)
    assert bench.opensplat.seconds_per_step(program, workload, 1) == pytest.approx(0.05)
    assert os.sched_getaffinity(0) == cores
    scene = load_scene(kept)
    assert len(scene.images) == len(workload.views)
    np.testing.assert_allclose(
        scene.images[0].camera.cam_from_world, workload.views[0].cam_from_world, atol=1e-12
    )
    gaussians = read_gaussians(kept / "gaussians.ply")
    np.testing.assert_array_equal(gaussians.shN, workload.gaussians.shN)
    header = (kept / "gaussians.ply").read_bytes()[:200]
    assert header.split(b"\n")[2] == b"comment Generated by opensplat at iteration 3000"
