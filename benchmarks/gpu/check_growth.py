"""Strategy grow on CUDA: contributions beside the CPU's, and a short run of it.

    python benchmarks/gpu/check_growth.py

The room of the demo, as many Gaussians as it has points. Prints the largest difference of pixels
and errors between the two rasterisers, as a part of the largest value, and the test PSNR of a run
of each strategy on each backend at one number of Gaussians.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import torch

from splatseed.io import load_scene
from splatseed.synthetic import make_capture, write_capture
from splatseed.train import TrainSettings, prepare_run
from splatseed.train.run import TrainingRun
from splatseed.train.settings import Backend, StrategyName
from splatseed.train.strategies.contributions import contributions

STEPS, CAP = 600, 6000


def main() -> None:
    """Print both comparisons."""
    if not torch.cuda.is_available():
        raise SystemExit("This needs a GPU and gsplat with CUDA.")
    with tempfile.TemporaryDirectory() as folder:
        scene = write_capture(
            make_capture(0, num_views=24, width=320, height=240), Path(folder) / "room"
        )
        begun = {backend: _run(scene, "grow", backend) for backend in ("cpu", "cuda")}
        print("largest difference of contributions:", _difference(begun["cpu"], begun["cuda"]))
        for strategy in ("default", "mcmc", "grow"):
            for backend in ("cpu", "cuda"):
                run = _run(scene, strategy, backend)
                run.train()
                count, seconds = len(run.state.params["means"]), run.state.watch.seconds
                print(
                    f"{strategy}, {backend}: {run.trainer.test_scores()[0]:.2f} dB, {count:,}, "
                    f"{seconds:.1f} s"
                )


def _run(scene: Path, strategy: StrategyName, backend: Backend) -> TrainingRun:
    settings = TrainSettings(strategy=strategy, backend=backend, max_steps=STEPS, cap_max=CAP)
    output = Path(tempfile.mkdtemp(dir=scene.parent)) / "run"
    return prepare_run(load_scene(scene), output, settings)


def _difference(cpu: TrainingRun, cuda: TrainingRun) -> float:
    """Of pixels and errors, as a part of the largest; the error is a ramp over the picture."""
    view = cpu.trainer.train_views[0]
    ramp = torch.linspace(0, 1, view.width).expand(view.height, -1).contiguous()
    ours = contributions(cpu.state.params, view, ramp)
    theirs = contributions(cuda.state.params, view, ramp.cuda())
    return max(
        float((a - b.cpu()).abs().max() / a.abs().max()) for a, b in zip(ours, theirs, strict=True)
    )


if __name__ == "__main__":
    main()
