"""The curve of a run: loss, PSNR and number of Gaussians, as a table and as a picture.

Notation: records are taken at regular steps; a record's loss is the mean since the one before.
Promise: both files appear whole or not at all, so that a run can be watched while it trains.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from splatseed.io.output.staging import atomic_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes


class Record(NamedTuple):
    """The progress of a run."""

    step: int
    """Steps done."""
    seconds: float
    """Seconds of training alone: not of reading, scoring or writing."""
    loss: float
    """Mean since the last record."""
    train_psnr: float
    """PSNR of the last training photograph, dB."""
    test_psnr: float | None
    """Mean over the test views, dB; None if not evaluated."""
    num_gaussians: int
    test_ssim: float | None = None
    """Mean over the test views; None where it was not taken."""


def write_curve_csv(path: Path, records: Sequence[Record]) -> None:
    """Write one row per record, with a header; a PSNR not taken is left blank.

    Raises:
        OutputError: The file cannot be written.
    """
    with atomic_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(Record._fields)
        writer.writerows(records)


def write_curve_png(path: Path, records: Sequence[Record]) -> None:
    """Draw loss, PSNR and number of Gaussians over the steps, one below the other.

    Raises:
        OutputError: The file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415  (slow to import)
    from matplotlib.figure import Figure  # noqa: PLC0415  (loads with its use)

    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    _draw_loss(top, records)
    _draw_psnr(middle, records)
    _draw_count(bottom, records)
    with atomic_file(path) as partial:
        figure.savefig(partial, dpi=100)


def _draw_loss(axes: Axes, records: Sequence[Record]) -> None:
    axes.semilogy([r.step for r in records], [r.loss for r in records], color="C3")
    axes.set_ylabel("loss")
    axes.grid(visible=True, which="both", alpha=0.3)


def _draw_psnr(axes: Axes, records: Sequence[Record]) -> None:
    axes.plot(
        [r.step for r in records],
        [r.train_psnr for r in records],
        color="C0",
        alpha=0.35,
        label="training, single photographs",
    )
    tested = [(r.step, r.test_psnr) for r in records if r.test_psnr is not None]
    axes.plot(*zip(*tested, strict=True), "o-", color="C0", label="test, mean")
    axes.set_ylabel("PSNR, dB")
    axes.legend(loc="lower right")
    axes.grid(visible=True, alpha=0.3)


def _draw_count(axes: Axes, records: Sequence[Record]) -> None:
    axes.plot([r.step for r in records], [r.num_gaussians for r in records], color="C2")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("Gaussians")
    axes.set_xlabel("step")
    axes.yaxis.set_major_formatter("{x:,.0f}")
    axes.grid(visible=True, alpha=0.3)
