"""Train the points of a scene and an upsampled cloud, and score both on views kept apart.

python examples/06_train_and_score.py [SCENE] [STEPS]

Without a scene of your own, a small made-up room takes its place. One run each says little: repeat
with other seeds before you believe a difference.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before PyTorch: see docs/training.md

import splatseed as ss
from splatseed.synthetic import make_capture, write_capture


def main(scene_dir: Path, steps: int) -> None:
    """Train twice, print the scores."""
    if not scene_dir.exists():
        write_capture(make_capture(seed=0, num_views=12, width=120, height=90), scene_dir)

    scene = ss.load_scene(scene_dir)
    for name, points in (
        ("sfm", scene.points),
        ("mls 4x", ss.upsample(scene, method="mls", ratio=4, seed=0)),
    ):
        run = ss.train(
            scene.replace(points=points),
            Path("runs") / name.replace(" ", "_"),
            strategy="none",
            seeding="scene",
            max_steps=steps,
            backend="cpu",
            overwrite=True,
        )
        scores = run.metrics
        print(
            f"{name:7s}{scores['psnr']:6.2f} dB  SSIM {scores['ssim']:.3f}"
            f"  {scores['num_gaussians']:6,} Gaussians  {scores['train_seconds']:.1f} s"
        )


if __name__ == "__main__":
    main(
        Path(sys.argv[1]) if len(sys.argv) > 1 else Path("example_room"),
        int(sys.argv[2]) if len(sys.argv) > 2 else 150,
    )
