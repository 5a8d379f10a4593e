"""The size at which a run can afford to compare photographs.

Notation: a pixel is *compared* once if stereo finds its depth, *rendered* once in each training
step that shows it. Promise: the size depends on the run's settings and the photographs' sizes
alone, never on the clock, so that the same seed gives the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from splatseed.scene import Image
from splatseed.stereo.settings import StereoSettings
from splatseed.train.settings import TrainSettings

PER_RENDERED: Mapping[str, float] = MappingProxyType({"cpu": 0.13, "cuda": 0.01})
"""Most pixels compared per pixel rendered in training, by the device that renders: stereo then
takes about a quarter of training's seconds (on the CPU: fern, 0.045: 5 of 47 s; bonsai at 1,500
steps, 0.68: 83 of 64 s). Comparing always runs on the CPU, some 0.7 million pixels a second and
core. The number for a GPU is an estimate: 150 million pixels rendered a second, beside 8 cores;
benchmarks/gpu measures both."""
LEAST_SIZE: Mapping[str, int] = MappingProxyType({"cpu": 64, "cuda": 200})
"""Smallest size that is returned, in pixels; on the CPU it is not below the size that is trained
either, which on a GPU is the photographs' own."""


def stereo_size(images: Sequence[Image], settings: TrainSettings, device: str) -> int:
    """Most pixels a side at which photographs are compared, for a run of this length.

    ``StereoSettings``' own where training takes much longer than comparing, otherwise fewer.

    Args:
        images: The training photographs.
        settings: Steps, and the size that is trained.
        device: Where training renders: cpu or cuda.
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
    affordable = int(most * math.sqrt(PER_RENDERED[device] * rendered / compared))
    least = max(LEAST_SIZE[device], longest // settings.data_factor if device == "cpu" else 0)
    return min(full, max(least, affordable))
