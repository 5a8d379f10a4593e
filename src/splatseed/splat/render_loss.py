"""What a change of a model costs: PSNR of its renders, from the same cameras before and after.

Notation: *stages* are versions of a model, such as the whole, a part of it, and the part as a
packed file gives it back. Renders are clamped to [0, 1], as for scores.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch

from splatseed.findings import Finding
from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.scene import BLACK, Color
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.metrics import psnr
from splatseed.splat.photographs import mask_tensor, photograph_tensor
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame
from splatseed.text import counted

MAX_LOST, MIN_LIKENESS = 0.3, 40.0
"""Packed files that lose more than the first number of dB against photographs, or whose renders
have less than the second against the model's, are reported. Renders at 40 dB cost a model of 30 dB
0.4 dB."""
TEST_VIEW = "test view"
_DIFFERENT = 0.5 / 255
"""Pixels nearer to the background in both renders show nothing, and are not compared."""


class RenderLoss(NamedTuple):
    """Scores of the stages of a model."""

    views: int
    scores: tuple[float, ...]
    """Mean PSNR of each stage against the photographs, dB; none without photographs."""
    likeness: tuple[float, ...]
    """PSNR of each stage but the first against the one before it, over the pixels of all views that
    show something, dB; infinite if they are equal, NaN if no view shows anything."""
    label: str = TEST_VIEW
    """What the views are."""

    def finding(self, suffix: str) -> Finding | None:
        """Return the finding on a packed file, the last stage; None if it is faithful."""
        if self.scores:
            before, after = self.scores[-2:]
            if before - after <= MAX_LOST:
                return None
            text = f"Its {suffix} costs the model {before - after:.2f} dB: {before:.2f} before, "
            text += f"{after:.2f} as the file is read ({counted(self.views, self.label)})."
        else:
            if not self.likeness[-1] < MIN_LIKENESS:
                return None
            text = f"Renders of the {suffix} differ from the model's: {self.likeness[-1]:.1f} dB "
            text += f"in {counted(self.views, 'view')}."
        return Finding("score-lost", text, fix="A .ply keeps everything.")


@torch.no_grad()
def measure_loss(
    stages: Sequence[Gaussians],
    views: Sequence[View],
    frame: TrainingFrame,
    device: torch.device | None = None,
    progress: Progress = silent,
    background: Color = BLACK,
    label: str = TEST_VIEW,
) -> RenderLoss:
    """Render all stages from all views, and compare.

    Args:
        stages: Two or more versions of a model, in the frame of the views.
        views: One or more; with photographs, all at the size of theirs.
        frame: To render in.
        device: Where to render, by default on the CPU.
        progress: Called with the name of a stage and its fraction done.
        background: Behind all Gaussians.
        label: What the views are, for messages.
    """
    renderers = [ModelRenderer(stage, frame, device, background) for stage in stages]
    scores: list[list[float]] = []
    errors, counts = np.zeros(len(stages) - 1), np.zeros(len(stages) - 1)
    for i, view in enumerate(views):
        images = [renderer.image(view).clamp(0, 1) for renderer in renderers]
        mask = mask_tensor(view, images[0].device)
        if view.photograph.size:
            photograph = photograph_tensor(view, images[0].device)
            scores.append([psnr(image, photograph, mask) for image in images])
        empty = images[0].new_tensor(background) / 255
        for j, pair in enumerate(pairwise(images)):
            shown = (torch.stack(pair) - empty).abs().amax(dim=(0, -1)) >= _DIFFERENT
            squares = (pair[1] - pair[0]).square()[shown if mask is None else shown & mask]
            errors[j] += float(squares.sum(dtype=torch.float64))
            counts[j] += squares.numel()
        progress("compare", (i + 1) / len(views))
    with np.errstate(divide="ignore", invalid="ignore"):
        likeness = -10 * np.log10(errors / counts)
    means = np.mean(scores, axis=0) if scores else ()
    return RenderLoss(len(views), tuple(map(float, means)), tuple(map(float, likeness)), label)
