"""Where to train, and how many Gaussians fit into memory there.

Promise: a requested GPU is used or an error, never silently replaced; a cloud too large to train is
refused before the first step, with the number that fits, and a growing one is held at what fits.
What is too much for a GPU all the same is told in a sentence with a number to try.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch

from splatseed.errors import PointCloudError
from splatseed.progress import Progress, silent
from splatseed.runtime.torch_device import free_bytes, load_kernels, pick_torch_device
from splatseed.train.settings import BYTES_EACH, Backend

FEWER = 0.8
"""The part of the Gaussians to try again with where memory ended."""


def pick_device(backend: Backend, progress: Progress = silent) -> torch.device:
    """The device that a backend stands for, ready to render; ``auto`` takes a GPU if there is one.

    Args:
        backend: The user's choice.
        progress: Called with the stage in which gsplat's kernels are built, the first time.

    Raises:
        ParameterError: CUDA is asked for and there is none.
        MissingDependencyError: gsplat has no kernels for the GPU and they cannot be built here.
    """
    device = pick_torch_device(backend, "--backend")
    if device.type == "cuda":
        load_kernels("--backend", progress)
    return device


@contextmanager
def gpu_memory_told(count: Callable[[], int]) -> Iterator[None]:
    """Turn the end of a GPU's memory in the block into one sentence.

    Args:
        count: The number of Gaussians at that time.

    Raises:
        PointCloudError: The memory did not suffice.
    """
    try:
        yield
    except torch.cuda.OutOfMemoryError as error:
        raise PointCloudError(
            "Gaussians and photographs that fit into the GPU's memory",
            found=f"no memory left with {count():,} Gaussians",
            fix=f"Start again with --budget {round(FEWER * count())} or smaller photographs "
            "(--data-factor), or end other programs on the GPU.",
        ) from error


def device_name(device: torch.device) -> str:
    """The device in words."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    threads = torch.get_num_threads()
    return f"CPU, {threads} thread{'s' * (threads > 1)}"


def check_fits(count: int, device: torch.device) -> None:
    """Refuse more Gaussians than can be trained.

    Raises:
        PointCloudError: There are too many.
    """
    free = free_bytes(device)
    if free is not None and count * BYTES_EACH > free:
        most = free // BYTES_EACH
        raise PointCloudError(
            f"at most {most:,} points, which the {free / 1e9:.1f} GB of free memory hold",
            found=f"{count:,}",
            fix=f"Pass --budget {most}, upsample less, or free some memory.",
        )


class Capacity:
    """How many Gaussians a run may grow to: the cap, or what fits into memory if that is less.

    Args:
        cap: The most Gaussians wanted; None for any number.
        device: Where they are.

    Attributes:
        held_at: The number at which memory first stopped a run from growing, else None. Such a run
            depends on the machine.
    """

    def __init__(self, cap: int | None, device: torch.device) -> None:
        self.cap = cap
        self.held_at: int | None = None
        self._device = device

    def limit(self, count: int, wanted: int) -> int:
        """The most that ``count`` Gaussians may become if the strategy wants ``wanted``."""
        most = wanted if self.cap is None else min(self.cap, wanted)
        free = free_bytes(self._device)
        if free is None or most - count <= free // BYTES_EACH:
            return most
        fits = count + free // BYTES_EACH
        self.held_at = self.held_at or fits
        return fits


def peak_gpu_bytes(device: torch.device) -> int | None:
    """Peak memory of PyTorch on a GPU so far, in bytes; None for the CPU."""
    return torch.cuda.max_memory_allocated(device) if device.type == "cuda" else None
