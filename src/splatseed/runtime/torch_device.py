"""Pick a PyTorch device, measure its free memory, and load gsplat's kernels.

A requested GPU is used, or there is an error. PyTorch is imported only when a device is picked.
"""

from __future__ import annotations

import io
import os
import shutil
import sys
import sysconfig
from contextlib import redirect_stdout
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, get_args

from filelock import FileLock

from splatseed.errors import MissingDependencyError, ParameterError
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.runtime.memory import free_memory

if TYPE_CHECKING:  # PyTorch may be absent, and takes a while to load
    import torch


DeviceName: TypeAlias = Literal["auto", "cpu", "cuda"]

BACKEND = "gsplat.cuda._backend"
"""gsplat's module that loads or builds its kernels when it is imported."""
BUILDING = "building gsplat's kernels, some minutes, once"


def pick_torch_device(choice: DeviceName, argument: str) -> torch.device:
    """Return the device for a choice; ``auto`` takes a GPU if PyTorch sees one."""
    import torch  # noqa: PLC0415  (see the file's docstring)

    if choice not in get_args(DeviceName):
        expected = f"`{argument}` of {', '.join(get_args(DeviceName))}"
        raise ParameterError(expected, found=repr(choice), fix="Choose one of these.")
    seen = torch.cuda.is_available()
    if choice == "cuda" and not seen:
        raise ParameterError(
            f"a GPU for `{argument}='cuda'`",
            found="none that PyTorch sees",
            fix=f"Pass `{argument}='cpu'`, or install PyTorch's CUDA build.",
        )
    return torch.device("cuda" if seen and choice != "cpu" else "cpu")


def free_bytes(device: torch.device) -> int | None:
    """Return the free memory of the device in bytes; None if unknown."""
    if device.type == "cuda":
        import torch  # noqa: PLC0415  (see the file's docstring)

        # PyTorch keeps freed blocks. They are free but for what the next render and its graph take
        # again, which is as much as at the peak so far.
        kept = torch.cuda.memory_reserved(device) - torch.cuda.max_memory_allocated(device)
        return max(0, torch.cuda.mem_get_info(device)[0] + kept)
    return free_memory()


def load_kernels(argument: str, progress: Progress = silent) -> None:
    """Load gsplat's CUDA kernels; build them the first time.

    gsplat 1.5.3 builds them on the first call. Without a toolkit, it prints "disabled" and fails
    at the first render; two processes that build at once delete each other's files, so a lock lets
    them build one after another.

    Args:
        argument: The argument that chooses the CPU instead, for errors.
        progress: Called with the stage of building.

    Raises:
        MissingDependencyError: gsplat is absent, or has no compiled kernels and they cannot be
            built here.
    """
    if getattr(sys.modules.get(BACKEND), "_C", None) is not None:
        return
    require("gsplat")
    from torch.utils import cpp_extension  # noqa: PLC0415  (slow to import, for builds only)

    # Ninja, which gsplat brings, is off the path of a venv's command called without activation.
    os.environ["PATH"] = f"{os.environ.get('PATH', '')}{os.pathsep}{sysconfig.get_path('scripts')}"
    home = cpp_extension.CUDA_HOME or os.environ.get("CUDA_HOME")
    compiler = os.environ.get("CXX") or ("cl" if os.name == "nt" else "c++")  # as PyTorch does
    tools = {
        "nvcc": (home and shutil.which("nvcc", path=Path(home, "bin"))) or shutil.which("nvcc"),
        compiler: shutil.which(compiler) or shutil.which(compiler.split()[0]),  # "ccache g++"
        "ninja": shutil.which("ninja"),
    }
    missing = [f"no {name}" for name, path in tools.items() if path is None]
    if missing and not find_spec("gsplat.csrc"):  # csrc: they came compiled
        raise _cannot_build(", ".join(missing), argument)
    root = os.environ.get("TORCH_EXTENSIONS_DIR") or cpp_extension.get_default_build_root()
    Path(root).mkdir(parents=True, exist_ok=True)
    with FileLock(Path(root, "gsplat_cuda.splatseed.lock")):
        if not any(Path(root).rglob("gsplat_cuda.so")):
            progress(BUILDING, 0.0)
        try:
            with redirect_stdout(io.StringIO()):  # gsplat's own line belongs to no output of ours
                loaded = getattr(import_module(BACKEND), "_C", None)
        except (ImportError, OSError, RuntimeError) as error:
            lines = [line for line in str(error).splitlines() if "error" in line.lower()]
            reason = (lines or [type(error).__name__])[0].strip()[:200]
            raise _cannot_build(f"{reason} ({tools['nvcc']})", argument) from error
    if loaded is None:
        raise _cannot_build("kernels that gsplat could not load", argument)


def _cannot_build(found: str, argument: str) -> MissingDependencyError:
    import torch  # noqa: PLC0415  (see the file's docstring)

    version = torch.version.cuda
    toolkit = f"the CUDA toolkit {version}" if version else "the CUDA toolkit of PyTorch's release"
    return MissingDependencyError(
        "gsplat's compiled kernels, or nvcc, a C++ compiler and ninja to build them",
        found=found,
        fix=f"Install {toolkit}, which PyTorch was built with, and g++ (ninja comes with gsplat), "
        f"or pass `{argument}='cpu'`.",
    )
