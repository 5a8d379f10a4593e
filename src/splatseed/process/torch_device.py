"""The PyTorch device that a user's choice stands for, and its free memory.

Promise: a requested GPU is used, or there is an error: it is never silently replaced. PyTorch is
imported only when a device is picked.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, TypeAlias

from splatseed.errors import ParameterError
from splatseed.process.memory import free_memory

if TYPE_CHECKING:  # PyTorch may be absent, and takes a while to load
    import torch


DeviceName: TypeAlias = Literal["auto", "cpu", "cuda"]


def pick_torch_device(choice: DeviceName, option: str) -> torch.device:
    """The device of a choice; ``auto`` takes a GPU if PyTorch sees one.

    Args:
        choice: What the user says.
        option: The option by which it was said, for errors.

    Raises:
        ParameterError: CUDA is requested and there is none.
    """
    import torch  # noqa: PLC0415  (see the promise)

    seen = torch.cuda.is_available()
    if choice == "cuda" and not seen:
        raise ParameterError(
            f"a GPU for {option} cuda",
            found="none that PyTorch sees",
            fix=f"Pass {option} cpu, or install PyTorch's CUDA build.",
        )
    return torch.device("cuda" if seen and choice != "cpu" else "cpu")


def free_bytes(device: torch.device) -> int | None:
    """Free memory of the device in bytes; None where the system does not tell."""
    if device.type == "cuda":
        import torch  # noqa: PLC0415  (see the promise)

        # PyTorch keeps freed blocks, which are free to us but for what the next render and its
        # graph take again: as much as at the peak so far.
        kept = torch.cuda.memory_reserved(device) - torch.cuda.max_memory_allocated(device)
        return max(0, torch.cuda.mem_get_info(device)[0] + kept)
    return free_memory()
