"""Scalars of a run for TensorBoard, an optional package."""

from __future__ import annotations

from pathlib import Path

from splatseed.requirements import require
from splatseed.train.record.curve import Record


class Board:
    """A TensorBoard log.

    Args:
        path: The folder of the log.
        step: Where the run resumes; entries of an interrupted run beyond it are dropped.

    Raises:
        MissingDependencyError: TensorBoard is not installed.
    """

    def __init__(self, path: Path, step: int) -> None:
        require("tensorboard")
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  (optional)

        self._writer = SummaryWriter(str(path), purge_step=step + 1)

    def add(self, record: Record) -> None:
        """Log a record."""
        scalars = {
            "loss": record.loss,
            "psnr/train": record.train_psnr,
            "psnr/test": record.test_psnr,
            "gaussians": record.num_gaussians,
            "seconds": record.seconds,
        }
        for name, value in scalars.items():
            if value is not None:
                self._writer.add_scalar(name, value, record.step)

    def close(self) -> None:
        """Write what is left."""
        self._writer.close()
