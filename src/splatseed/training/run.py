"""A training run: it trains, scores its test views if any, and leaves a folder of results.

Promise: results are in the scene's frame; running out of GPU memory raises one error that suggests
a budget; an interrupted run keeps a checkpoint.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from splatseed.errors import OutputError, PointCloudError
from splatseed.findings import LOGGER
from splatseed.io.staging import write_json
from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.scores import CurvePoint, EvalResult, TrainingResult
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.pictures import picture_names, write_comparison
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame
from splatseed.training.device import device_name
from splatseed.training.folder import Record, RunFolder, write_curve_csv, write_curve_png
from splatseed.training.hidden import recolored
from splatseed.training.margins import has_margins, with_margins
from splatseed.training.parameters import take_mean
from splatseed.training.settings import TrainSettings
from splatseed.training.state import TrainState, save_checkpoint
from splatseed.training.trainer import Trainer

Score = Callable[..., EvalResult]
"""Scores renders against views, as ``evaluate_views`` does."""

CHECKPOINT_SECONDS = 60.0
"""Minimum seconds between checkpoints, so that saving takes a small part of the time."""
RETRY_FRACTION = 0.8
"""After running out of memory: the fraction of the Gaussians to suggest as a budget."""
BOARD_NAMES = ("seconds", "loss", "psnr/train", "psnr/test", "gaussians", "ssim/test")
"""TensorBoard's names of a record's numbers, after the step."""


class TrainingRun:
    """A run that is ready to train, at its first step or where it stopped.

    ``views`` are the training and the test views, in the scene's frame.
    """

    def __init__(
        self,
        folder: RunFolder,
        settings: TrainSettings,
        frame: TrainingFrame,
        state: TrainState,
        views: tuple[Sequence[View], Sequence[View]],
    ) -> None:
        self.folder, self.settings, self.state, self.frame = folder, settings, state, frame
        self._board: Any = None  # TensorBoard's writer, if requested
        self._saved, self._saved_step = time.monotonic(), state.step or None
        self._train_views, self._test_views = views
        train, test = ([frame.view(view) for view in part] for part in views)
        self._pictures = picture_names(view.name for view in test)
        self.trainer = Trainer(state, settings, train, test, self._on_record)

    def log_to_tensorboard(self) -> None:
        """Also write TensorBoard's log, into the run's folder."""
        from torch.utils.tensorboard import SummaryWriter  # noqa: PLC0415  (optional)

        # Entries of an interrupted run beyond this step are dropped.
        path, first = self.folder.tensorboard, self.state.step + 1
        self._board = SummaryWriter(str(path), purge_step=first)
        self.folder.claim([path])

    def count(self) -> int:
        """Return the number of Gaussians."""
        return len(self.state.params["means"])

    @property
    def device(self) -> str:
        """The name of the GPU, or the CPU's number of threads."""
        return device_name(self.trainer.device)

    @property
    def peak_gpu_bytes(self) -> int | None:
        """Maximum bytes that PyTorch has held on the GPU; None on the CPU."""
        device = self.trainer.device
        return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None

    def train(self, on_step: Callable[[int], None] = lambda _: None) -> bool:
        """Train to the last step, or until the user interrupts, and save a checkpoint.

        Args:
            on_step: Called after each step with the number of steps done.

        Returns:
            Whether the last step is done.

        Raises:
            OutputError: The checkpoint or the curve cannot be written.
            PointCloudError: The GPU's memory does not suffice; the checkpoint is of the last step.
        """
        with self.translate_errors():
            if self._saved_step is None:
                self._save()  # fail now rather than after hours if the disk is full
            try:
                done = self.trainer.run(on_step)
            except torch.cuda.OutOfMemoryError:
                if self.trainer.is_consistent:  # else the previous checkpoint is the last one
                    self.trainer.clear_gradients()
                    self._save()
                raise
            if self._board:
                self._board.close()
            self._save()  # for a finished run too: scoring and writing results may fail
        return done

    def finish(self, score: Score, progress: Progress = silent) -> TrainingResult:
        """Write and score the Gaussians, write the results, and remove the checkpoint.

        Returns:
            The content of metrics.json.

        Raises:
            OutputError: A result cannot be written.
            PointCloudError: The GPU's memory does not suffice.
        """
        state, folder = self.state, self.folder
        if state.step < self.settings.max_steps:  # the last step takes the mean itself
            take_mean(state.params, state.mean)
        with self.translate_errors():
            model = self._model(progress)
            progress("score", 0.0)
            folder.claim([folder.renders / name for name in self._pictures.values()])
            write_gaussians(folder.gaussians, model)
            # The file that the user gets is scored, read back.
            world = read_gaussians(folder.gaussians)
            render = ModelRenderer(world, self.frame, self.trainer.device).image
            scores = EvalResult(())
            if self._test_views:
                scores = score(render, self._test_views, on_view=self._draw)
            self._end_curve(scores, len(world))
            result = TrainingResult(
                dataclasses.replace(scores, num_gaussians=len(world), model_bytes=world.num_bytes),
                tuple(
                    CurvePoint(r.step, r.seconds, r.test_psnr, r.num_gaussians, r.test_ssim)
                    for r in state.records
                    if r.test_psnr is not None
                ),
                steps=state.step,
                train_seconds=round(state.watch.seconds, 3),
                num_seeds=folder.read_config()["seeds"]["count"],
                held_by_memory_at=state.strategy.capacity.held_at,
            )
            write_curve_csv(folder.curve_csv, state.records)
            write_curve_png(folder.curve_png, state.records)
            write_json(folder.metrics, result.to_dict())  # last: the run has finished
            folder.checkpoint.unlink(missing_ok=True)
        return result

    def _model(self, progress: Progress) -> Gaussians:
        """Return the Gaussians in the scene's frame, with what photographs do not show."""
        state, views, cap = self.state, self._train_views, self.settings.cap
        dropout = self.settings.schedule.dropout_at(state.step, len(views))
        model = recolored(state.params, self.trainer.train_views, dropout, progress)
        model = self.frame.gaussians_to_world(model)
        if not has_margins(self.settings, views):
            return model
        return with_margins(model, self.frame, views, cap, self.trainer.device, progress)

    def _end_curve(self, scores: EvalResult, num_gaussians: int) -> None:
        """Make the curve end with the scores of the model that was written."""
        records = self.state.records
        if records and records[-1].step == self.state.step:
            last = records[-1]._replace(num_gaussians=num_gaussians)
            if scores.per_image:
                last = last._replace(test_psnr=scores.psnr, test_ssim=scores.ssim)
            records[-1] = last

    def _draw(
        self, view: View, render: Float32[np.ndarray, "H W 3"], errors: Float32[np.ndarray, "H W"]
    ) -> None:
        path = self.folder.renders / self._pictures[view.name]
        write_comparison(path, view.photograph, render, errors)

    def _on_record(self, record: Record) -> None:
        if self._board:
            for name, value in zip(BOARD_NAMES, record[1:], strict=True):
                if value is not None:
                    self._board.add_scalar(name, value, record.step)
        if record.test_psnr is None and self._test_views:
            return
        text = "step %d: %d Gaussians, PSNR %.2f dB"
        shown = [record.step, record.num_gaussians, record.train_psnr]
        if record.test_psnr is not None:
            text, shown = f"{text}, of test views %.2f dB", [*shown, record.test_psnr]
        LOGGER.debug(text, *shown)
        write_curve_csv(self.folder.curve_csv, self.state.records)
        if self._saved_step is None or time.monotonic() - self._saved > CHECKPOINT_SECONDS:
            self._save()

    def _save(self) -> None:
        save_checkpoint(self.folder.checkpoint, self.state)
        self._saved, self._saved_step = time.monotonic(), self.state.step

    @contextmanager
    def translate_errors(self) -> Iterator[None]:
        """Re-raise out-of-memory and write errors, naming the last checkpoint."""
        try:
            yield
        except torch.cuda.OutOfMemoryError as error:
            raise PointCloudError(
                "Gaussians and photographs that fit into the GPU's memory",
                found=f"no memory left with {self.count():,} Gaussians",
                fix=f"Start again with `budget={round(RETRY_FRACTION * self.count())}` or smaller "
                f"photographs (`data_factor`), or end other programs on the GPU.{self._kept()}",
            ) from error
        except OutputError as error:
            fix = error.fix + self._kept()
            raise OutputError(error.expected, found=error.found, fix=fix) from error
        except KeyboardInterrupt as error:
            if kept := self._kept():
                error.add_note(kept.strip())
            raise

    def _kept(self) -> str:
        """Name the checkpoint, to be appended to a message; empty without one."""
        if self._saved_step is None:
            return ""
        return f" The run as of step {self._saved_step:,} is kept: continue it with `resume=True`."
