"""The size at which a run can afford to compare photographs.

Notation: a pixel is *compared* once if stereo finds its depth, *rendered* once in each training
step that shows it. Promise: the size depends on the run's settings and the photographs' sizes
alone, never on the clock, so that the same seed gives the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from splatseed.scene import Image
from splatseed.stereo.settings import StereoSettings
from splatseed.train.settings import TrainSettings

__all__ = ["PER_RENDERED", "stereo_size"]

PER_RENDERED = 0.13
"""Most pixels compared per pixel rendered in training: stereo then takes about a quarter of
training's seconds (on the CPU: fern, 0.045: 5 of 47 s; bonsai at 1,500 steps, 0.68: 83 of 64 s)."""
LEAST_SIZE = 64
"""Smallest size that is returned, in pixels."""


def stereo_size(images: Sequence[Image], settings: TrainSettings) -> int:
    """Most pixels a side at which photographs are compared, for a run of this length.

    ``StereoSettings``' own where training takes much longer than comparing; otherwise fewer, down
    to the size that is trained.

    Args:
        images: The training photographs.
        settings: Steps, and the size that is trained.
    """
    full = StereoSettings().max_size
    if not images:
        return full
    longest = max(max(image.camera.width, image.camera.height) for image in images)
    pixels = sum(image.camera.width * image.camera.height for image in images)
    most = min(full, longest)
    compared = pixels * (most / longest) ** 2
    rendered = settings.max_steps * pixels / len(images) / settings.data_factor**2
    # Pixels go with the square of the size.
    affordable = most * math.sqrt(PER_RENDERED * rendered / compared)
    return min(full, max(LEAST_SIZE, longest // settings.data_factor, int(affordable)))
