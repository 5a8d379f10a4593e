"""Runs: they learn, repeat to the byte, go on to the byte, and refuse what they must."""

from __future__ import annotations

import csv
import dataclasses
import json
import os
import shutil
import signal

import numba
import numpy as np
import pytest
import torch
from PIL import Image as PilImage

from splatseed.errors import OutputError, ParameterError, PointCloudError, SceneFormatError
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.scene import Split
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.formats import read_gaussians
from splatseed.splat.pictures import BAND
from splatseed.splat.rendering import opacity_from_logits
from splatseed.training import device, prepare, run as run_module, trainer
from splatseed.training.evaluation import Evaluation
from splatseed.training.parameters import add_to_mean, gaussians_of, size_unit
from splatseed.training.prepare import prepare_run
from splatseed.training.request import EvaluateRequest, PrepareOptions
from splatseed.training.settings import TrainSettings
from splatseed.viewer.models import ViewerItem, viewer_frame

RESUME, CAP = {"resume": True}, 400


def _bytes(run):
    arrays = gaussians_of(run.state.params).arrays()
    return {name: np.ascontiguousarray(array).tobytes() for name, array in arrays.items()}


def _stop_after(step, times=1):
    """Ctrl-C during that step."""

    def on_step(done):
        for _ in range(times if done == step else 0):
            os.kill(os.getpid(), signal.SIGINT)

    return on_step


@pytest.mark.parametrize(
    ("strategy", "gain"), [("default", 1.7), ("grow", 2.5), ("mcmc", 1.2), ("none", 2.5)]
)
def test_training_makes_unseen_views_better(begin, strategy, gain):
    """By about half of what it gained when this was written, or more."""
    run = begin(strategy=strategy, cap_max=4000)
    before = run.trainer.test_scores()[0]
    assert run.train()
    assert run.trainer.test_scores()[0] > before + gain


def test_a_second_signal_says_what_is_kept(begin):
    with pytest.raises(KeyboardInterrupt) as stop:
        begin().train(_stop_after(5, times=2))
    assert stop.value.__notes__ == ["The run as of step 0 is kept: continue it with `resume=True`."]


@pytest.fixture
def single_threaded():
    """A function that leaves one thread to PyTorch and Numba until the test ends."""
    before = torch.get_num_threads(), numba.get_num_threads()
    yield lambda: (torch.set_num_threads(1), numba.set_num_threads(1))
    torch.set_num_threads(before[0])
    numba.set_num_threads(before[1])


def test_opacities_are_the_same_whatever_the_threads(single_threaded):
    def of_logits():
        logits = torch.linspace(-9, 9, 100_003, requires_grad=True)  # more than one thread takes
        opacities = opacity_from_logits(logits)
        opacities.backward(torch.ones_like(logits))
        return opacities, logits.grad

    torch.set_num_threads(3)
    several = of_logits()
    single_threaded()
    assert all(map(torch.equal, several, of_logits()))
    assert torch.allclose(several[0], torch.linspace(-9, 9, 100_003).sigmoid())


# While Gaussians are added, and while the mean is taken.
@pytest.mark.parametrize(
    ("strategy", "stop", "exposure"),
    [("default", 17, "none"), ("mcmc", 17, "none"), ("none", 55, "none"), ("grow", 17, "affine")],
)
def test_a_run_goes_on_to_the_byte_whatever_the_threads(
    begin, strategy, stop, exposure, single_threaded, compare_anew
):
    settings = {"strategy": strategy, "cap_max": CAP, "exposure": exposure}
    straight = begin("straight", **settings)
    before = torch.get_rng_state()
    assert straight.train()
    assert torch.equal(torch.get_rng_state(), before)  # the caller's own
    single_threaded()
    stopped = begin("stopped", **settings)
    assert not stopped.train(_stop_after(stop))
    assert stopped.state.step == stop
    assert stopped.folder.checkpoint.is_file()
    resumed = begin("stopped", RESUME, **settings)
    assert resumed.state.step == stop
    assert resumed.train()
    assert _bytes(resumed) == _bytes(straight)
    of_both = [[r._replace(seconds=0) for r in run.state.records] for run in (straight, resumed)]
    assert of_both[0] == of_both[1]
    counts = [record.num_gaussians for record in straight.state.records]
    assert (counts[-1] > counts[0]) == (strategy != "none")
    assert max(counts) <= CAP


def test_another_seed_gives_another_run(begin):
    one, other = (begin(str(seed), strategy="none", max_steps=5, seed=seed) for seed in (0, 1))
    assert one.train()
    assert other.train()
    assert _bytes(one) != _bytes(other)


def test_a_stray_pose_is_named_and_has_no_part_in_the_frame(room, tmp_path):
    """One camera 10,000 units away once made the others' views black: the frame followed it."""
    images = sorted(room.images, key=lambda image: image.name)
    far = dataclasses.replace(images[2], translation=images[2].translation + np.array([0, 0, 1e4]))
    runs, findings = [], []
    for name, each in (("left out", []), ("stray", [far])):
        scene = room.replace(images=(*images[:2], *each, *images[3:]))
        asked = TrainSettings(data_factor=2, test_every=9)
        runs.append(prepare_run(scene, tmp_path / name, asked, note=findings.append))
    assert _bytes(runs[0]) == _bytes(runs[1])
    findings = [each for each in findings if each.kind != "margins"]
    assert [(each.kind, far.name in each.text) for each in findings] == [("stray-cameras", True)]


def test_missing_photographs_change_no_other_views_part(room_path, tmp_path):
    shutil.copytree(room_path, tmp_path / "room")
    whole = load_scene(tmp_path / "room")
    train, test = (list(part) for part in whole.split(3))
    for gone in (test.pop(0), train.pop(1)):
        (whole.source.image_dir / gone.name).unlink()
    settings = TrainSettings(strategy="none", data_factor=2, test_every=3)
    run = prepare_run(whole, tmp_path / "run", settings)
    for views, images in ((run.trainer.train_views, train), (run.trainer.test_views, test)):
        assert [view.name for view in views] == [image.name for image in images]


def test_a_walk_is_learnt_however_long_it_is(room, tmp_path):
    """From 100 units to 20,000, past things as near as ever: 2,400 once rendered nothing."""
    scores = []
    for step in (100.0, 20_000.0):
        moved = np.array([step, 0.0, 0.0])
        images = [
            dataclasses.replace(
                image, translation=image.translation - image.camera.cam_from_world[:3, :3] @ moved
            )
            if i % 2
            else image
            for i, image in enumerate(room.images)
        ]
        xyz = np.concatenate([room.points.xyz, room.points.xyz + moved.astype(np.float32)])
        points = PointCloud(xyz, np.tile(room.points.rgb, (2, 1)))
        scene = room.replace(images=tuple(images), points=points, tracks=None)
        asked = TrainSettings(strategy="none", data_factor=2, max_steps=10)
        run = prepare_run(scene, tmp_path / f"{step}", asked, note=pytest.fail)
        assert run.train()
        scores.append(run.trainer.test_scores()[0])
        config, stage = run.folder.read_config(), viewer_frame(ViewerItem("walk", scene))
        assert config["near_plane"] == pytest.approx(run.frame.near / run.frame.scale)
        assert (stage.near, stage.scale) == pytest.approx((run.frame.near, run.frame.scale))
    assert scores[1] == pytest.approx(scores[0], abs=0.05)


def test_a_run_ends_with_the_mean_of_its_last_fifth(begin, monkeypatch):
    run = begin(strategy="none", max_steps=40)
    seen = []

    def note(mean, params):
        add_to_mean(mean, params)
        seen.append({name: value.detach().clone() for name, value in params.items()})

    monkeypatch.setattr(trainer, "add_to_mean", note)
    run.train()
    assert len(seen) == 8
    for name in ("means", "scales", "quats", "opacities", "sh0", "shN"):
        expected = torch.stack([each[name] for each in seen]).mean(dim=0)
        torch.testing.assert_close(run.state.params[name].detach(), expected, rtol=1e-4, atol=1e-5)
        assert not torch.equal(run.state.params[name], seen[-1][name])


def test_3dgs_conventions_end_with_the_last_step_and_have_one_length_unit(begin):
    run = begin(strategy="default-3dgs", max_steps=60, cap_max=3000)
    count = len(run.state.params["means"])
    run.train()
    assert not run.state.mean
    assert size_unit(run.state.params).tolist() == pytest.approx([1.1])
    assert len(run.state.params["means"]) > count


def test_opacities_are_reset_on_request(begin):
    run = begin(max_steps=21, opacity_reset=True)  # every 2nd step while refining
    run.train()
    assert run.state.strategy.resets
    # The last reset, to 0.01, is 10 steps ago: Adam's rate lets a logit grow 0.05 a step at most.
    assert torch.sigmoid(run.state.params["opacities"]).max() < 0.05


def test_results_are_whole_and_in_the_scenes_world(begin, room, draw_curves, score_often):
    run = begin(max_steps=20)
    seeds_in_world = run.frame.points_to_world(gaussians_of(run.state.params).means)
    assert np.allclose(seeds_in_world, room.points.xyz, atol=1e-4)
    run.train()
    result, folder = run.finish(evaluate_views), run.folder
    assert json.loads(folder.metrics.read_text()) == result.to_dict()
    assert result.held_by_memory_at is None
    assert [test.step for test in result.curve] == list(range(1, 21))
    last, end = result.curve[-1], result.scores
    assert (last.psnr, last.ssim) == pytest.approx((end.psnr, end.ssim), abs=1e-4)
    assert len(read_gaussians(folder.gaussians)) == result.scores.num_gaussians
    assert json.loads(folder.config.read_text())["data_factor"] == 2
    rows = list(csv.DictReader(folder.curve_csv.open()))
    assert int(rows[-1]["step"]) == 20
    curves = np.asarray(PilImage.open(folder.curve_png))
    assert curves.shape[1] > 100
    assert len(np.unique(curves.reshape(-1, curves.shape[2]), axis=0)) > 20  # lines on white
    pictures = sorted(folder.renders.iterdir())
    assert len(pictures) == 2
    assert PilImage.open(pictures[0]).size == (3 * 48 + 8, 36 + BAND)
    assert not folder.checkpoint.exists()
    assert not list(folder.path.glob(".*partial*"))


def test_tensorboard_logs_what_the_curve_has(begin):
    pytest.importorskip("tensorboard", reason="an optional package")
    run = begin(ways={"tensorboard": True}, max_steps=5)
    run.train()
    assert [path.stat().st_size > 100 for path in run.folder.tensorboard.iterdir()] == [True]


def test_an_earlier_run_is_neither_replaced_nor_repeated_by_accident(begin, room, tmp_path):
    def refused(match, *given):
        with pytest.raises(OutputError, match=match):
            begin(*given, max_steps=3)

    run = begin(max_steps=3)
    refused("unfinished run.*resume=True")
    run.train()
    run.finish(evaluate_views)
    refused(r"found a finished run")
    refused("a finished one", "run", RESUME)
    assert begin(ways={"overwrite": True}, max_steps=3).state.step == 0
    assert not run.folder.metrics.exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("keep")
    refused("did not write", "mine", {"overwrite": True})
    with pytest.raises(OutputError, match="apart from the input"):
        prepare_run(room, room.source.root / "run", TrainSettings())


def test_another_split_is_found_out(begin, room, tmp_path):
    """A list of test images that is new since the run began: of views that it was trained on."""
    names = sorted(image.name for image in room.images)
    listed = room.replace(listed=Split(frozenset(names[2:]), frozenset(names[:2]), "test.txt"))
    settings = TrainSettings(max_steps=2, data_factor=2, strategy="none")
    run = begin(max_steps=2, strategy="none")
    run.train(_stop_after(1))
    with pytest.raises(ParameterError, match=r"other training or test images.*by its test\.txt\)"):
        prepare_run(listed, tmp_path / "run", settings, PrepareOptions(**RESUME))
    resumed = begin(ways=RESUME, max_steps=2, strategy="none")
    resumed.train()
    resumed.finish(evaluate_views)
    found = "The run was trained on 1 of these 2 views: the scene's split was another."
    split = "The split is that of the scene's test.txt: 7 training and 2 test images"
    for scene, every, texts in (
        (room, None, []),
        (listed, None, [f"{split}.", found]),
        (listed, 3, [f"{split}; `test_every` is ignored.", found]),
    ):
        evaluation = Evaluation.of(tmp_path / "run", scene, EvaluateRequest(test_every=every))
        assert [each.text for each in evaluation.findings(evaluation.load())] == texts
    findings = []
    start = TrainSettings(max_steps=2, data_factor=2, start=str(resumed.folder.gaussians))
    prepare_run(listed, tmp_path / "next", start, note=findings.append)
    assert [len(f.subjects) for f in findings if f.kind == "trained-test-views"] == [1]


def test_a_run_goes_on_with_its_own_settings_and_seeds(begin, room, tmp_path):
    run = begin(max_steps=30, strategy="none", sh_degree=1)
    run.train(_stop_after(4))
    resumed = prepare_run(room, tmp_path / "run", TrainSettings(), PrepareOptions(**RESUME))
    assert resumed.settings == run.settings
    with pytest.raises(ParameterError, match="max_steps=30"):
        begin(ways=RESUME, max_steps=31, strategy="none")
    fewer = room.replace(points=room.points.select(slice(50)))
    with pytest.raises(ParameterError, match="other points"):
        prepare_run(fewer, tmp_path / "run", TrainSettings(), PrepareOptions(**RESUME))
    run.folder.checkpoint.write_bytes(b"damaged")
    with pytest.raises(SceneFormatError, match="checkpoint"):
        prepare_run(room, tmp_path / "run", TrainSettings(), PrepareOptions(**RESUME))


def test_a_disk_that_is_full_among_the_results_costs_nothing(begin, monkeypatch):
    """The first test view's record leaves a checkpoint, and so does the last step."""
    run, seen = begin(max_steps=30), []
    run.train(lambda step: seen.append(run.folder.checkpoint.is_file()) if step == 20 else None)
    assert seen == [True]

    def disk_full(path, *_):
        raise OutputError(f"{path}", found="No space left on device", fix="Free some.")

    with monkeypatch.context() as patch:
        patch.setattr(run_module, "write_comparison", disk_full)
        with pytest.raises(OutputError, match=r"No space left.*as of step 30 is kept.*resume"):
            run.finish(evaluate_views)
    assert not run.folder.metrics.exists()
    resumed = begin(ways=RESUME, max_steps=30)
    assert (resumed.state.step, resumed.train()) == (30, True)
    assert _bytes(resumed) == _bytes(run)
    resumed.finish(evaluate_views)
    assert resumed.folder.metrics.is_file()
    assert not resumed.folder.checkpoint.exists()


def test_what_does_not_fit_the_memory_is_refused_with_what_would(begin, monkeypatch, tmp_path):
    monkeypatch.setattr(device, "free_bytes", lambda _: 100 * device.BYTES_PER_GAUSSIAN)
    with pytest.raises(PointCloudError, match="budget=100"):
        begin()
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("strategy", ["default", "grow", "mcmc"])
def test_memory_holds_growth_and_the_run_says_so(begin, monkeypatch, strategy):
    run = begin(strategy=strategy, cap_max=4000)
    begun, each = run.count(), device.BYTES_PER_GAUSSIAN
    monkeypatch.setattr(device, "free_bytes", lambda _: each * (begun + 9 - run.count()))
    assert run.train()
    assert begun < max(r.num_gaussians for r in run.state.records) <= begun + 9
    assert run.finish(evaluate_views).held_by_memory_at == begun + 9


def test_a_gpu_that_is_not_there_is_not_replaced_in_silence(begin, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ParameterError, match=r"backend=.cpu"):
        begin(backend="cuda")


def test_a_distorted_lens_is_refused_before_seeds_are_made(room, tmp_path, monkeypatch):
    monkeypatch.setattr(prepare, "seeded", None)
    first = room.images[0]
    params = *first.intrinsics.params, 0.1, 0, 0, 0
    lens = dataclasses.replace(first.intrinsics, model="OPENCV", params=params)
    bent = dataclasses.replace(first, intrinsics=lens)
    with pytest.raises(SceneFormatError, match="splatseed undistort"):
        prepare_run(room.replace(images=(bent,)), tmp_path / "run", TrainSettings())
