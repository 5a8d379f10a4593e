"""Where to train, and how many Gaussians fit into memory there.

Promise: a requested GPU is used, or its absence is an error; more points than memory can hold are
refused before the first step, with the number that fits; growth stops at that number.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from splatseed.errors import PointCloudError
from splatseed.progress import Progress, silent
from splatseed.runtime.torch_device import free_bytes, load_kernels, pick_torch_device
from splatseed.text import counted
from splatseed.training.settings import BYTES_PER_GAUSSIAN, Backend


def pick_device(backend: Backend, progress: Progress = silent) -> torch.device:
    """Return the device of a backend, ready to render; ``auto`` takes a GPU if there is one.

    The first call on a GPU builds gsplat's kernels and reports it to ``progress``.

    Raises:
        ParameterError: CUDA is asked for and there is none.
        MissingDependencyError: gsplat has no kernels for the GPU and they cannot be built here.
    """
    device = pick_torch_device(backend, "backend")
    if device.type == "cuda":
        load_kernels("backend", progress)
    return device


def device_name(device: torch.device) -> str:
    """Return the name of a GPU, or the number of the CPU's threads."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    return f"CPU, {counted(torch.get_num_threads(), 'thread')}"


def check_fits(count: int, device: torch.device) -> None:
    """Refuse more Gaussians than can be trained."""
    free = free_bytes(device)
    if free is not None and count * BYTES_PER_GAUSSIAN > free:
        limit = free // BYTES_PER_GAUSSIAN
        raise PointCloudError(
            f"at most {limit:,} points, which the {free / 1e9:.1f} GB of free memory hold",
            found=f"{count:,}",
            fix=f"Pass `budget={limit}`, upsample less, or free some memory.",
        )


@contextmanager
def on_one_thread(device: torch.device) -> Iterator[None]:
    """Let PyTorch compute on one thread of the CPU while the block runs.

    For functions of gsplat's whose last digits depend on the number of threads, as sigmoid's do.
    """
    threads = torch.get_num_threads()
    if device.type == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class Capacity:
    """How many Gaussians a run may grow to: the cap, or what fits into memory if that is less."""

    def __init__(self, cap: int | None, device: torch.device) -> None:
        self.cap = cap
        self._device = device
        self.held_at: int | None = None
        """The number at which memory first stopped a run, which then depends on the machine."""

    def limit(self, count: int, wanted: int) -> int:
        """Return the number to which ``count`` Gaussians may grow: at most ``wanted``."""
        limit = wanted if self.cap is None else min(self.cap, wanted)
        free = free_bytes(self._device)
        if free is None or limit - count <= free // BYTES_PER_GAUSSIAN:
            return limit
        fits = count + free // BYTES_PER_GAUSSIAN
        self.held_at = self.held_at or fits
        return fits
