"""What ``export --budget`` and ``--drop-isolated`` choose, against other rules.

Test views are taken out of each capture; of the rest every eighth is held out of training, and
scored. Runs in the work folder are not trained again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree

import splatseed as ss
from benchmarks.common.clouds import find_scenes
from benchmarks.common.ledger import report
from benchmarks.common.markdown import table
from benchmarks.training.seeding_arms import TEST_EVERY
from splatseed.photos.view import View
from splatseed.sampling import evenly_spaced
from splatseed.splat.formats import read_gaussians
from splatseed.splat.gaussians import SH_C0, Gaussians
from splatseed.splat.render_loss import measure_loss
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.selection import isolated, largest, visible_area
from splatseed.training import model_views
from splatseed.training.decimation import fit_sizes, most_needed, needs
from splatseed.training.folder import config_of, model_file
from splatseed.training.parameters import make_parameters
from splatseed.training.strategies.grow import contributions

__all__: list[str] = []

CPU = torch.device("cpu")
NUM_FLOATERS = 200


@dataclass(frozen=True)
class Options:
    """Thin runs to budgets, and plant floaters in them."""

    captures: tuple[str, ...] = ("fern", "fox", "face", "desk", "dorm", "stone_horse")
    """Captures, by their names in the folder of captures."""
    work: Path = Path("export_choices")
    """Folder of their models."""
    max_steps: int = 400
    """Training steps."""
    long_side: int = 300
    """Longer side of the photographs, in pixels; a model has as many Gaussians as one has."""
    shares: tuple[float, ...] = (0.75, 0.5, 0.25)
    """Budgets, of the Gaussians."""
    views: int = 20
    """Training views that have a part, evenly spaced; export takes all."""
    floaters: bool = True
    """Also measure the removal of floaters."""


Importance = Float[np.ndarray, " N"]


def main(options: Options) -> None:
    """Print both tables."""
    lost: dict[str, list[tuple[float, ...]]] = {}
    cleaned = []
    for capture in options.captures:
        run = _trained(find_scenes() / capture, options)
        path, config = model_file(run), config_of(run)
        gaussians = read_gaussians(path)
        found = model_views.find_model_views(path, gaussians, Path(config["scene"]), config)
        some = [found.train[i] for i in evenly_spaced(len(found.train), options.views)]
        views = found._replace(train=tuple(some))
        for name, losses in _thinned(gaussians, views, options.shares).items():
            lost.setdefault(name, []).append(losses)
        if options.floaters:
            cleaned += [(capture, *row) for row in _cleaned(gaussians, views)]
        report(f"  {capture}: {len(gaussians):,} Gaussians, {len(views.train)} training views")
    header = [f"{share:.0%} of the Gaussians" for share in options.shares]
    rows = [(name, *map(_mean_and_worst, zip(*each, strict=True))) for name, each in lost.items()]
    print(table(("loss in dB: mean, worst", *header), rows))
    if cleaned:
        header = ["capture", "rule", "found", "wrong", "with floaters", "cleaned", "without any"]
        print("\n" + table(header, cleaned))


def _trained(capture: Path, options: Options) -> Path:
    """Train on a capture without its test views; return the folder of the run."""
    run = options.work / f"{capture.name}_run"
    if not run.exists():
        scene, shown = ss.load_scene(capture), options.work / capture.name
        ss.write_scene(scene.replace(images=scene.split(TEST_EVERY)[0]), shown, overwrite=True)
        ss.train(
            shown, run, strategy="grow", max_steps=options.max_steps,
            long_side=options.long_side, budget="1rho",
        )  # fmt: skip
    return run


def _mean_and_worst(losses: Sequence[float]) -> str:
    return f"{np.mean(losses):.2f}, {max(losses):.2f}"


def _scores(models: list[Gaussians], views: model_views.ModelViews) -> tuple[float, ...]:
    return measure_loss(models, views.test, views.frame).scores


def _thinned(
    gaussians: Gaussians, views: model_views.ModelViews, shares: tuple[float, ...]
) -> dict[str, tuple[float, ...]]:
    """Return the loss in PSNR by rule, for each budget."""
    framed = views.frame.gaussians_from_world(gaussians)
    seen = [views.frame.view(view) for view in views.train]
    by_sum, by_max = _contributions(framed, seen)
    rules: dict[str, Importance] = {
        "need, measured once": needs(framed, seen, CPU),
        "contribution, summed over the views": by_sum,
        "contribution, largest of a view": by_max,
        "opacity x area": visible_area(gaussians),
        "opacity": gaussians.opacities,
        "random": np.random.default_rng(0).random(len(gaussians)),
    }
    whole = _scores([gaussians, gaussians], views)[0]
    losses: dict[str, list[float]] = {}
    for share in shares:
        count = round(share * len(gaussians))
        keeps = {"need, in rounds": most_needed(gaussians, views, count, CPU)}
        keeps |= {name: largest(each, count) for name, each in rules.items()}
        models = [gaussians.select(keep) for keep in keeps.values()]
        models.append(fit_sizes(models[0], gaussians, views, CPU)[0])
        names = [*keeps, "need, in rounds, sizes fitted: in use"]
        for name, score in zip(names, _scores(models, views), strict=True):
            losses.setdefault(name, []).append(whole - score)
    return {name: tuple(each) for name, each in losses.items()}


def _contributions(gaussians: Gaussians, views: list[View]) -> tuple[Importance, Importance]:
    """Return the sum of blending weights over all views, and its largest over a view."""
    params = make_parameters(gaussians, CPU)
    pixels = [
        contributions(params, view, torch.zeros(view.height, view.width))[0] for view in views
    ]
    stacked = torch.stack(pixels)
    return stacked.sum(dim=0).numpy(), stacked.amax(dim=0).numpy()


def _cleaned(gaussians: Gaussians, views: model_views.ModelViews) -> list[list[str]]:
    """Plant floaters, and return what each rule finds."""
    both = _with_floaters(gaussians, views)
    planted = np.arange(len(both)) >= len(gaussians)
    rules: dict[str, Callable[[Gaussians], Bool[np.ndarray, " N"]]] = {
        "isolated": isolated,
        "statistical, 1 deviation": lambda model: _statistical(model, 1.0),
        "statistical, 2 deviations": lambda model: _statistical(model, 2.0),
    }
    rows = []
    for name, rule in rules.items():
        bad = rule(both)
        models = [both, both.select(~bad), gaussians, gaussians.select(~rule(gaussians))]
        floating, cleaned, whole, needless = _scores(models, views)
        counts = [f"{np.count_nonzero(bad & each):,}" for each in (planted, ~planted)]
        shown = f"{whole:.2f}, cleaned {needless:.2f}"
        rows.append([name, *counts, f"{floating:.2f}", f"{cleaned:.2f}", shown])
    return rows


def _with_floaters(gaussians: Gaussians, views: model_views.ModelViews) -> Gaussians:
    """Add opaque balls at 0.2 to 0.8 of the depth of random pixels, of about the median size."""
    rng, means = np.random.default_rng(0), list[np.ndarray]()
    renderer = ModelRenderer(gaussians, views.frame)
    depths = [renderer.depth(view) for view in views.train]
    while len(means) < NUM_FLOATERS:
        i = rng.integers(len(depths))
        row, column = (rng.integers(side) for side in depths[i].shape)
        depth, view = depths[i][row, column] * rng.uniform(0.2, 0.8), views.train[i]
        if depth > 0:
            ray = np.linalg.solve(view.K, [column + 0.5, row + 0.5, 1.0])
            means.append((np.linalg.inv(view.cam_from_world) @ [*(ray * depth), 1])[:3])
    size = np.median(gaussians.scales) + rng.uniform(-0.7, 0.7, (NUM_FLOATERS, 1))
    rest = gaussians.shN.shape[1]
    floaters = {
        "means": np.array(means),
        "scales": np.repeat(size, 3, axis=1),
        "quats": np.tile([1.0, 0, 0, 0], (NUM_FLOATERS, 1)),
        "opacities": np.full(NUM_FLOATERS, 3.0),
        "sh0": (rng.uniform(size=(NUM_FLOATERS, 1, 3)) - 0.5) / SH_C0,
        "shN": np.zeros((NUM_FLOATERS, rest, 3)),
    }
    joined = {
        name: np.concatenate([each, floaters[name].astype(np.float32)])
        for name, each in gaussians.arrays().items()
    }
    return Gaussians(**joined)


def _statistical(gaussians: Gaussians, deviations: float) -> Bool[np.ndarray, " N"]:
    """Statistical outlier removal: mean distance to 16 neighbours, against all others' mean."""
    distances = cKDTree(gaussians.means).query(gaussians.means, 17, workers=-1)[0][:, 1:]
    mean = distances.mean(axis=1)
    return np.asarray(mean > mean.mean() + deviations * mean.std())


if __name__ == "__main__":
    main(tyro.cli(Options))
