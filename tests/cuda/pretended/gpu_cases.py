"""Training on a pretended GPU beside the CPU; ``test_pretended_gpu`` runs this in its own process.

Held here: every operator's device, what gsplat's kernels check, optimisers and strategies while
Gaussians come and go, checkpoints across devices, the waits of a step, TF32, and what a user reads
when memory or the toolkit is missing.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import pretend_cuda as pc  # before PyTorch

import fake_gsplat

fake_gsplat.install()

import numpy as np
import pytest
import torch

from splatseed.errors import MissingDependencyError, PointCloudError
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.metrics import mirrored_ssim
from splatseed.integrations.gsplat import GrowStrategy
from splatseed.io import load_scene
from splatseed.io.depth_maps import depth_folder
from splatseed.runtime import torch_device
from splatseed.splat import photographs, rendering
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.synthetic import make_capture, write_capture
from splatseed.training import PrepareOptions, TrainSettings, prepare_run, state, trainer
from splatseed.training.depths import DepthCache
from splatseed.training.device import Capacity
from splatseed.training.parameters import as_parameters
from splatseed.viewer import pictures
from splatseed.viewer.models import ViewerItem, viewer_frame
from splatseed.photos.loading import load_split

STEPS = 12
VIEWS = 4
"""Training views: 5 less a test view."""


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room")
    capture = make_capture(0, num_views=VIEWS + 1, width=48, height=36)
    return load_scene(write_capture(capture, folder / "room"))


@pytest.fixture(autouse=True)
def few_records(monkeypatch):
    monkeypatch.setattr(trainer, "NUM_TESTS", 1)
    monkeypatch.setattr(trainer, "NUM_RECORDS", 2)


def _begin(room, output, strategy, backend, max_steps=STEPS, **ways):
    settings = TrainSettings(strategy=strategy, backend=backend, max_steps=max_steps, cap_max=400)
    options = PrepareOptions(**ways)
    cache = DepthCache(output.parent / "depths.npz")
    return prepare_run(room, output, settings, options, depth_cache=cache)


def _waits():
    """What waited for the GPU, but for gsplat's own code: by kind and place."""
    return {
        (kind, place): n
        for (kind, place), n in pc.WHERE.items()
        if not place.startswith("gsplat/") and kind not in {"queued copy", "isect: item"}
    }


@pytest.mark.parametrize("strategy", ["default", "mcmc", "grow"])
def test_a_run_on_cuda_takes_the_steps_of_the_cpu(room, tmp_path, strategy):
    cpu = _begin(room, tmp_path / "cpu", strategy, "cpu")
    cpu.train()
    with pc.pretended_gpu():
        gpu = _begin(room, tmp_path / "cuda", strategy, "cuda")
        gpu.train()
        assert all(each.is_cuda for each in gpu.state.params.values())
        scores = gpu.finish(evaluate_views).scores
    expected = cpu.finish(evaluate_views).scores
    # A gradient on the threshold may make another Gaussian.
    for name, tolerance in (("num_gaussians", 0.01), ("loss", 2e-3)):
        ours, theirs = ([getattr(r, name) for r in run.state.records] for run in (gpu, cpu))
        np.testing.assert_allclose(ours, theirs, rtol=tolerance)
    assert scores.psnr == pytest.approx(expected.psnr, abs=0.1)


def test_growth_in_another_trainers_loop_stays_on_the_gpu(room, tmp_path):
    view = load_split(room)[0][0]
    with depth_folder(tmp_path / "maps", "z") as writer:
        writer.write(view.name, np.full((6, 8), 2.0, np.float32))
    with pc.pretended_gpu():
        device = torch.device("cuda")
        first = initial_gaussians(room.points).arrays()
        params = as_parameters({n: torch.tensor(v, device=device) for n, v in first.items()})
        optimizers = {name: torch.optim.Adam([value]) for name, value in params.items()}
        camera = rendering.camera_tensors(view, device)
        truth = photographs.photograph_tensor(view, device)[None]
        strategy = GrowStrategy(2000, 12, 60, 12, depths=tmp_path / "maps", depth_scale=1.0)
        state = strategy.initialize_state()
        for step in range(13):
            seen = camera.viewmats, camera.Ks, torch.zeros_like(truth), truth
            strategy.observe(params, state, step, *seen, [view.name])
            strategy.step_post_backward(params, optimizers, state, step, {}, lr=0.1)
        assert len(room.points) < len(params["means"]) <= 2000
        assert all(value.is_cuda for value in params.values())


@pytest.mark.parametrize("strategy", ["default", "mcmc", "grow", "none"])
def test_a_step_does_not_wait_for_the_gpu(room, tmp_path, monkeypatch, strategy):
    """Once each view was shown, but for rounds, which look at how many Gaussians they change."""
    if strategy == "none":  # nor where photographs are sent anew
        monkeypatch.setattr(photographs, "MAX_MEMORY_SHARE", 0.0)
    waits = {}

    def count(step):
        waits[step] = _waits()
        pc.WHERE.clear()
        if step == 3 * VIEWS:
            os.kill(os.getpid(), signal.SIGINT)

    with pc.pretended_gpu():
        run = _begin(room, tmp_path / "run", strategy, "cuda", max_steps=3000)
        every = run.settings.schedule.refine_every
        pc.WHERE.clear()
        assert not run.train(count)
    plain = [step for step in waits if step > VIEWS and (step - 1) % every]
    assert len(plain) > VIEWS
    assert {step: waits[step] for step in plain} == {step: {} for step in plain}


@pytest.mark.parametrize(
    ("strategy", "order"),
    [("default", ("cpu", "cuda")), ("mcmc", ("cuda", "cpu")), ("grow", ("cuda", "cpu"))],
)
def test_a_checkpoint_goes_on_on_the_other_device(room, tmp_path, strategy, order):
    def stop(step):
        if step == STEPS // 2:
            os.kill(os.getpid(), signal.SIGINT)

    with pc.pretended_gpu():
        first = _begin(room, tmp_path / "run", strategy, order[0])
        assert not first.train(stop)
        then = _begin(room, tmp_path / "run", strategy, order[1], resume=True)
        assert then.state.step == STEPS // 2
        assert then.train()
        assert then.trainer.device.type == order[1]
        states = [s for each in then.state.optimizers.values() for s in each.state.values()]
        assert {s["exp_avg"].device.type for s in states} == {order[1]}


def _ends(*_):
    raise torch.cuda.OutOfMemoryError("CUDA out of memory.")


@pytest.mark.parametrize("during", ["render", "optimize"])
def test_the_end_of_memory_is_told_and_keeps_the_last_whole_step(
    room, tmp_path, monkeypatch, during
):
    """A step cut off in its middle is not kept; the checkpoint before it is."""
    name = {"render": "photometric_loss", "optimize": "optimize"}[during]
    work, calls = getattr(trainer, name), []

    def fails(*given):
        calls.append(given)
        return work(*given) if len(calls) != 6 else _ends()

    with pc.pretended_gpu():
        run = _begin(room, tmp_path / "run", "default", "cuda")
        monkeypatch.setattr(trainer, name, fails)
        kept = 5 if during == "render" else 0
        with pytest.raises(PointCloudError, match=f"as of step {kept} is kept") as caught:
            run.train()
        assert f"budget={round(0.8 * run.count())}" in caught.value.fix
        monkeypatch.undo()
        monkeypatch.setattr(state, "as_parameters", _ends)
        with pytest.raises(torch.cuda.OutOfMemoryError):  # not a damaged checkpoint
            _begin(room, tmp_path / "run", "default", "cuda", resume=True)
        monkeypatch.undo()
        monkeypatch.setattr(trainer, "NUM_TESTS", 1)
        again = _begin(room, tmp_path / "run", "default", "cuda", resume=True)
        assert again.state.step == kept
        assert again.train()


def test_memory_that_ends_before_the_first_step_leaves_no_folder(room, tmp_path, monkeypatch):
    monkeypatch.setattr(trainer, "photometric_loss", _ends)
    with pc.pretended_gpu(), pytest.raises(PointCloudError, match="budget"):
        _begin(room, tmp_path / "run", "default", "cuda")
    assert not (tmp_path / "run").exists()


def test_without_a_toolkit_one_error_comes_before_any_work(room, tmp_path, monkeypatch):
    monkeypatch.delitem(sys.modules, torch_device.BACKEND)
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("CUDA_HOME", "CUDA_PATH", "CXX"):
        monkeypatch.delenv(name, raising=False)
    stages = []
    settings = TrainSettings(backend="cuda", max_steps=STEPS, seeding="auto")
    with pc.pretended_gpu(), pytest.raises(MissingDependencyError) as caught:
        prepare_run(room, tmp_path / "run", settings, progress=lambda s, _: stages.append(s))
    assert all(tool in caught.value.found for tool in ("c++", "nvcc"))
    assert "ninja" not in caught.value.found  # it lies beside this Python, not on the path
    assert "backend" in caught.value.fix
    assert not stages
    assert not (tmp_path / "run").exists()


def test_memory_counts_what_the_next_render_takes_again(monkeypatch):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (3 << 30, 24 << 30))
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda *_: 10 << 30)
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda *_: 8 << 30)
    assert (
        torch_device.free_bytes(pc.GPU) == 5 << 30
    )  # 3 unreserved, 2 in blocks that no step has used
    capacity = Capacity(None, pc.GPU)
    assert capacity.limit(1000, 10**9) == capacity.held_at == 1000 + (5 << 30) // 2000


def _pair():
    rng = np.random.default_rng(0)
    ramps = np.linspace(0.2, 0.9, 40)[:, None, None], np.linspace(0.5, 1, 31)[:, None]
    x = (ramps[0] * ramps[1] * np.ones(3)).astype(np.float32)
    y = np.clip(x + rng.normal(0, 0.03, x.shape), 0, 1).astype(np.float32)
    return torch.from_numpy(x), torch.from_numpy(y)


def _loss(x, y):
    x = x.clone().requires_grad_()
    value = trainer.photometric_loss(x, y)
    value.backward()
    return float(value.detach()), x.grad.cpu()


def test_the_loss_on_cuda_is_that_of_the_cpu_whatever_tf32_does():
    x, y = _pair()
    value, gradient = _loss(x, y)
    assert torch.backends.cudnn.allow_tf32  # PyTorch's default
    with pc.pretended_gpu():
        found, found_gradient = _loss(x.to("cuda"), y.to("cuda"))
        scored = mirrored_ssim(x.to("cuda"), y.to("cuda"))
    assert torch.backends.cudnn.allow_tf32
    assert found == pytest.approx(value, rel=1e-5)
    assert scored == pytest.approx(mirrored_ssim(x, y), abs=1e-5)
    torch.testing.assert_close(found_gradient, gradient, rtol=1e-3, atol=1e-7)


def test_fused_ssim_is_taken_where_it_is_installed(monkeypatch):
    calls = []

    def fused_ssim(x, y, padding):
        calls.append((tuple(x.shape), x.is_contiguous(), padding))
        return (x - y).mean()

    monkeypatch.setattr(trainer, "_fused_ssim", lambda: fused_ssim)
    x, y = _pair()
    with pc.pretended_gpu():
        found, _ = _loss(x.to("cuda"), y.to("cuda"))
    assert calls == [((1, 3, 40, 31), True, "valid")]
    expected = 0.8 * (x - y).abs().mean() + 0.2 * (1 - (x - y).mean())
    assert found == pytest.approx(float(expected), rel=1e-6)


def test_the_viewer_renders_all_gaussians_while_the_camera_moves(room, monkeypatch):
    gaussians = initial_gaussians(room.points)
    item = ViewerItem("room", room, gaussians)
    frame = viewer_frame(item)
    monkeypatch.setattr(pictures, "MAX_MOVING", len(gaussians) // 2)
    view = load_split(room)[0][0]
    with pc.pretended_gpu():
        entry = pictures.Entry(item, frame, pc.GPU)
        assert entry.fast_renderer is entry.renderer
        found = entry.renderer.color(view)
    expected = pictures.Entry(item, frame).renderer.color(view)
    np.testing.assert_allclose(found, expected, atol=1e-3)
