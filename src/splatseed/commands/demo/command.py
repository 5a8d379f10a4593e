"""``splatseed demo``: the whole workflow on a synthetic capture with known surfaces.

It photographs a synthetic room, finds points as Structure-from-Motion would, writes them as a
COLMAP scene, reads that back, upsamples it and shows the result. Then it does so by every method,
and measures how far the new points lie from the true surfaces and how well they cover them. Then,
if PyTorch and gsplat are installed, it trains briefly and compares: from poses alone, where a
trainer starts at random, and from the points as they are and upsampled. A second process compiles
kernels ahead of the first.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from splatseed.commands.demo.kernels import TRAINING, KernelsAhead, kernels_ahead, wait
from splatseed.commands.demo.methods import SEED, SHOWN
from splatseed.commands.options import parse_options
from splatseed.console import print_commands, print_note, print_pairs, print_table, stage_display
from splatseed.errors import MissingDependencyError, OutputError, ParameterError
from splatseed.io.staging import MANIFEST, add_files, read_manifest
from splatseed.literal import quoted
from splatseed.requirements import require

if TYPE_CHECKING:  # importing PyTorch takes a while, and it may be absent
    from splatseed.commands.demo.training import TrainedArm

TRAINED_PICTURE = "preview_trained.png"


@dataclass(frozen=True)
class Options:
    """Make a small scene, upsample it by every method, train from it, and show the result."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo")
    """The folder to write."""
    views: int = 40
    """Photographs of the synthetic room."""
    train_steps: int = 500
    """Training steps from each of four sets of seeds; 0 for no training."""
    training: Literal["now", "later", "only"] = "now"
    """When to train: now, at the end; later, while PyTorch is being installed; only, in a
    demo folder that was made with later."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "demo", arguments)
    _check(options)
    with kernels_ahead(training=options.training != "only" and options.train_steps > 0) as ahead:
        if options.training != "only":
            from splatseed.commands.demo.points import make_points  # noqa: PLC0415  (loads Numba)

            make_points(options, ahead)
        if options.training == "later":
            with stage_display() as clock:
                wait(ahead, TRAINING, clock)
            return
        trained = _train(options, ahead) if options.train_steps else False
    _say_what_next(options, trained=trained)


def _check(options: Options) -> None:
    """Refuse early what would fail after a minute's work."""
    if options.train_steps < 0:
        raise ParameterError(
            "--train-steps of 0 or more", found=f"{options.train_steps}", fix="Pass 0 not to train."
        )
    if options.training == "only" and read_manifest(options.output).get("command") != "demo":
        raise OutputError(
            f"a demo at {options.output}", found="none", fix="Make it first: splatseed demo."
        )


def _train(options: Options, ahead: KernelsAhead) -> bool:
    """Train from each set of seeds and compare, if the required packages are installed."""
    try:
        require("torch", "gsplat")
    except MissingDependencyError as error:
        print_note(f"not trained: {error.found} installed. {error.fix}")
        return False
    # These import PyTorch.
    from splatseed.commands.demo.training import (  # noqa: PLC0415  (loads with its use)
        POSES_ALONE,
        Arm,
        seed_poses_alone,
        train_arm,
        write_comparison,
    )
    from splatseed.train.settings import TrainSettings  # noqa: PLC0415  (loads with its use)

    folder = options.output
    runs = [f"run_{name}" for name in ("sfm", SHOWN)]
    alone = [f"{kind}_{name}" for name in POSES_ALONE.values() for kind in ("scene", "run")]
    add_files(folder, [*runs, *alone, TRAINED_PICTURE])
    seeded = json.loads((folder / f"scene_{SHOWN}" / MANIFEST).read_text(encoding="utf-8"))
    arms = [
        Arm("SfM seeds", folder / "scene", folder / runs[0]),
        Arm(SHOWN, folder / f"scene_{SHOWN}", folder / runs[1], seeded["seconds"]),
    ]
    settings = TrainSettings(
        strategy="default",
        cap_max=seeded["num_points"],
        max_steps=options.train_steps,
        seed=SEED,
    )
    with stage_display() as clock:
        wait(ahead, TRAINING, clock)
        arms = [*seed_poses_alone(folder, SEED, clock), *arms]
        trained = [train_arm(arm, settings, clock) for arm in arms]
        write_comparison(trained, folder / TRAINED_PICTURE)
    _summarise_training(options, trained)
    return True


def _summarise_training(options: Options, trained: Sequence[TrainedArm]) -> None:
    """The runs side by side, and what they do and do not show."""
    from splatseed.commands.demo.training import total_seconds  # noqa: PLC0415  (as above)

    least = min(total_seconds(each) for each in trained)
    print_table(
        f"{options.train_steps:,} training steps, "
        f"{len(trained[0].result.scores.per_image)} test views",
        ("seeds", "Gaussians", "seconds", "PSNR, dB", "SSIM", f"dB after {least:.0f} s"),
        [_row(each, least) for each in trained],
    )
    print_pairs(
        "what this shows",
        [
            ("poses alone", "the first two rows know no points: trainers then start at random"),
            ("fixed", "3DGS's densification, and the most Gaussians"),
            ("seconds", "of training and making the seeds; the last column is during training,"),
            ("", "before the mean that a run ends with is taken"),
            ("limits", "a synthetic room, one run each, no error bars; strategy grow, which"),
            ("", "splatseed train takes for short runs, gains more, and needs seeds less"),
            ("pictures", str(options.output / TRAINED_PICTURE)),
        ],
    )


def _row(each: TrainedArm, least: float) -> tuple[str, ...]:
    from splatseed.commands.demo.training import psnr_after, total_seconds  # noqa: PLC0415  (loads with its use)

    scores, then = each.result.scores, psnr_after(least, each)
    return (
        each.arm.label,
        f"{scores.num_gaussians:,}",
        f"{total_seconds(each):.1f}",
        f"{scores.psnr:.2f}",
        f"{scores.ssim:.4f}",
        "not begun" if then is None else f"{then:.2f}",
    )


def _say_what_next(options: Options, *, trained: bool) -> None:
    scene, seeded = (options.output / name for name in ("scene", f"scene_{SHOWN}"))
    run = options.output / f"run_{SHOWN}"
    commands = [
        (
            "another method",
            f"splatseed upsample {quoted(scene)} --method spline --ratio 16 -o OUT",
        ),
        ("a longer run", f"splatseed train {quoted(seeded)} --max-steps 3000 -o RUN"),
    ]
    if trained:
        commands.append(("the scores again", f"splatseed evaluate {quoted(run)}"))
    print_commands("next", commands)
