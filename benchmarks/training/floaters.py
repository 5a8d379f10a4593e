"""What ``export --clean`` removes: PSNR of held-out training views, and floaters put in on purpose.

Each capture's test views are taken out, and every eighth of the rest is held out and scored. A
model is cleaned as it is, and once more with ``put_in`` opaque Gaussians of random colours in free
space before it, 0.3 to 0.7 of the way from a training camera to what it sees, one to four pixels
wide: *found* of them, and how many *others* went. Prints Markdown; ``--pictures`` writes views from
beside the first camera: the model with these floaters, and cleaned.

    python -m benchmarks.training.floaters --scenes room fern dorm
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from benchmarks.common.clouds import find_scenes
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from benchmarks.training.baseline import say
from benchmarks.training.seeding_arms import TEST_EVERY, validation_split
from PIL import Image

import splatseed as ss
from splatseed.errors import SplatseedError
from splatseed.photos.view import View, camera_views
from splatseed.scene import Scene
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.gaussians import SH_C0, Gaussians
from splatseed.splat.pictures import to_uint8
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame, training_frame
from splatseed.synthetic import make_capture, write_capture
from splatseed.training import TrainSettings, prepare_run
from splatseed.training.depths import known_depths
from splatseed.training.floaters import find_floaters
from splatseed.training.parameters import gaussians_of
from splatseed.training.settings import StrategyName

__all__: list[str] = []

ROOM = "room"
"""The made room, beside the names of captures."""
HERE = TrainingFrame(np.zeros(3), 1.0)
"""Models and views are in the training frame already."""
ASIDE = 0.5
"""How far the camera of the pictures is moved to its right, in training units."""


@dataclass(frozen=True)
class Settings:
    """What to run."""

    scenes: tuple[str, ...] = (ROOM, "fern", "dorm", "desk", "face", "stone_horse", "treehill")
    """Captures, and the made room."""
    strategies: tuple[StrategyName, ...] = ("grow", "default")
    """How the models are trained."""
    max_steps: int = 500
    """Training steps."""
    long_side: int = 200
    """Most pixels a side."""
    rho: float = 0.25
    """Most Gaussians, per pixel of a photograph at that size."""
    put_in: int = 200
    """Floaters to put in."""
    pictures: Path | None = None
    """A folder for pictures."""


def measure(scene: Scene, name: str, strategy: StrategyName, settings: Settings) -> list[str]:
    """Train, clean, put floaters in, and clean again: a row of the table."""
    camera = scene.images[0].camera
    factor = -(-max(camera.width, camera.height) // settings.long_side)
    cap = round(settings.rho * (camera.width // factor) * (camera.height // factor))
    how = TrainSettings(
        strategy=strategy, max_steps=settings.max_steps, data_factor=factor, cap_max=cap,
        test_every=TEST_EVERY, backend="cpu",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        run = prepare_run(scene, Path(folder) / "run", how)
        run.train()
    views, held = run.trainer.train_views, run.trainer.test_views
    scale = training_frame(camera_views(scene.split(TEST_EVERY)[0])).scale
    looking = TrainSettings(strategy="grow", data_factor=factor, test_every=TEST_EVERY)
    depths, _ = known_depths(scene, scale, looking, "cpu")
    model = gaussians_of(run.state.params)
    wrong = _floaters(model, views, settings.put_in)
    both = Gaussians(
        **{
            each: np.concatenate([array, wrong.arrays()[each]])
            for each, array in model.arrays().items()
        }
    )
    gone, again = (find_floaters(each, views, depths, run.trainer.device) for each in (model, both))
    cleaned = both.select(~again)
    scores = [
        evaluate_views(ModelRenderer(each, HERE).image, held).psnr
        for each in (model, model.select(~gone), both, cleaned)
    ]
    if settings.pictures:
        _draw(settings.pictures / f"{name}_{strategy}.png", views[0], (model, both, cleaned))
    row = [name, strategy, f"{len(model):,}", f"{gone.sum():,}"]
    row += [f"{scores[0]:.2f}", f"{scores[1] - scores[0]:+.3f}"]
    found = again[len(model) :].sum()
    row += [f"{found} of {len(wrong)}", f"{again[: len(model)].sum()}"]
    row += [f"{scores[2]:.2f}", f"{scores[3]:.2f}"]
    say(" | ".join(row))
    return row


def _floaters(model: Gaussians, views: Sequence[View], count: int) -> Gaussians:
    """Opaque Gaussians in free space, in the training frame."""
    rng, means, sizes = np.random.default_rng(0), [], []
    renderer = ModelRenderer(model, HERE)
    for i in range(count):
        view = views[i % len(views)]
        row, column = int(rng.integers(view.height)), int(rng.integers(view.width))
        depth = rng.uniform(0.3, 0.7) * float(renderer.depth(view)[row, column])
        ray = np.linalg.inv(view.K) @ [column + 0.5, row + 0.5, 1.0]
        pose = view.cam_from_world
        means.append(pose[:3, :3].T @ (ray * depth - pose[:3, 3]))
        sizes.append(rng.uniform(0.5, 2.0) * depth / view.K[0, 0])
    arrays = {
        "means": np.array(means),
        "scales": np.repeat(np.log(np.maximum(sizes, 1e-6))[:, None], 3, axis=1),
        "quats": np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        "opacities": np.full(count, 3.0),
        "sh0": (rng.random((count, 1, 3)) - 0.5) / SH_C0,
        "shN": np.zeros((count, *model.shN.shape[1:])),
    }
    return Gaussians(**{name: each.astype(np.float32) for name, each in arrays.items()})


def _draw(path: Path, view: View, models: Sequence[Gaussians]) -> None:
    """Renders of the models in a row, from beside a view."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pose = view.cam_from_world.copy()
    pose[0, 3] -= ASIDE
    beside = view.posed(pose)
    pictures = [to_uint8(ModelRenderer(each, HERE).color(beside)) for each in models]
    Image.fromarray(np.concatenate(pictures, axis=1)).save(path)


def main(settings: Settings) -> None:
    """Measure and print the table."""
    rows = []
    for name in settings.scenes:
        with tempfile.TemporaryDirectory() as folder:
            if name == ROOM:
                made = make_capture(0, num_views=24, width=160, height=120)
                scene = ss.load_scene(write_capture(made, Path(folder) / name))
            else:
                scene = ss.load_scene(find_scenes() / name)
            split = validation_split(scene, 1, 0)
            rows += [measure(split, name, each, settings) for each in settings.strategies]
    header = ["capture", "strategy", "Gaussians", "removed", "PSNR, dB", "change"]
    header += ["found", "others", "with floaters, dB", "cleaned, dB"]
    print(f"{describe()}\n\n{table(header, rows)}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
