"""The summary at the end of a benchmark: each arm so far, failures, and what to run next."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Sequence
from pathlib import Path
from statistics import fmean

from splatseed.bench.planning.records import SFM, Arm, RunRow
from splatseed.bench.running.kept import ERROR, kept_folder
from splatseed.commands.bench.display import describe
from splatseed.console import print_commands, print_note, print_pairs, print_table
from splatseed.literal import counted, quoted

FAILURES_SHOWN = 5


def print_summary(bench: Path, rows: Sequence[RunRow]) -> None:
    """Print the arms' means so far.

    Args:
        bench: The benchmark's folder.
        rows: The runs of its plan.
    """
    _print_arms([row for row in rows if row.result])
    failed = [row for row in rows if row.status == "failed"]
    if failed:
        shown = [(describe(row.spec), row.error) for row in failed[:FAILURES_SHOWN]]
        print_pairs(f"failed: {len(failed)}", shown)
        where = kept_folder(bench, failed[0].spec.key) / ERROR
        print_note(f"The first error in full: {where}")
    _print_next(bench, rows, len(failed))


def _print_arms(done: Sequence[RunRow]) -> None:
    arms: dict[Arm, list[RunRow]] = defaultdict(list)
    for row in done:
        arms[row.spec.arm].append(row)
    if arms:
        print_table(
            "so far: means over scenes and repeats, and over those that sfm has too",
            (
                "seeds",
                "strategy",
                "budget",
                "runs",
                "PSNR, dB",
                "against sfm",
                "Gaussians",
                "seconds",
            ),
            [_arm_row(rows, _baselines(done)) for rows in arms.values()],
        )


def _arm_row(rows: Sequence[RunRow], baselines: dict[tuple[str, ...], float]) -> tuple[str, ...]:
    arm, results = rows[0].spec.arm, [row.result for row in rows if row.result]
    gains = [
        row.result.psnr - baselines[_pair(row)]
        for row in rows
        if row.result and _pair(row) in baselines and arm.method != SFM
    ]
    return (
        arm.label,
        arm.strategy,
        arm.budget,
        f"{len(rows)}",
        f"{fmean(each.psnr for each in results):.2f}",
        f"{fmean(gains):+.2f}" if gains else "",
        f"{fmean(each.num_gaussians for each in results):,.0f}",
        f"{fmean(each.seconds for each in results):.1f}",
    )


def _baselines(done: Sequence[RunRow]) -> dict[tuple[str, ...], float]:
    """The PSNR of the original cloud, by what paired runs have in common."""
    return {
        _pair(row): row.result.psnr for row in done if row.result and row.spec.arm.method == SFM
    }


def _pair(row: RunRow) -> tuple[str, ...]:
    return (row.spec.scene, row.spec.arm.strategy, row.spec.arm.budget, f"{row.spec.repeat}")


def _print_next(bench: Path, rows: Collection[RunRow], failed: int) -> None:
    name = quoted(bench)
    left = sum(row.status == "pending" for row in rows)
    elsewhere = sum(row.status == "running" for row in rows)
    if elsewhere:
        print_note(
            f"Another process has {counted(elsewhere, 'run')}, or had when it was last seen."
        )
    commands = []
    if left or elsewhere:
        commands.append(
            (f"the other {counted(left + elsewhere, 'run')}", f"splatseed bench -o {name}")
        )
    if failed:
        commands.append(("retry what failed", f"splatseed bench -o {name} --retry-failed"))
    print_commands("next", [*commands, ("tables and pictures", f"splatseed bench report {name}")])
