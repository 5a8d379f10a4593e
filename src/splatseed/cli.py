"""The command line: picks the verb, runs it, and turns our errors into one line and exit code 2."""

from __future__ import annotations

import io
import logging
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import NoReturn

from rich.table import Table

from splatseed.console import ERR, OUT
from splatseed.errors import ParameterError, ReconstructionError, SplatseedError
from splatseed.literal import did_you_mean, visible
from splatseed.process.interruption import Termination, exit_code

VERBS = {
    "upsample": "Add points to a scene and write it for any 3DGS trainer.",
    "train": "Train 3D Gaussians on a scene, on a GPU or on the CPU.",
    "evaluate": "Score a trained model: PSNR, SSIM, LPIPS.",
    "export": "Write a trained model as .ply, .spz, .sog or .splat; crop it.",
    "view": "Look at scenes and models in the browser.",
    "flight": "Make a video of a flight through a trained model.",
    "bench": "Compare methods by training: many runs, resumable, then a report.",
    "tune": "Find the best seeds and strategy for a scene by short runs on it.",
    "depth": "Make depth maps of the photographs, by a network or by stereo.",
    "info": "Show what is in a scene, and what is wrong with it.",
    "sfm": "Make a scene from photographs (pycolmap).",
    "undistort": "Take lens distortion out of a scene (pycolmap).",
    "demo": "Make a small scene, upsample it by every method, measure, train.",
}
OF_ITSELF = ("--help", "--version", "--completion")
"""Options without a verb."""


def main(arguments: list[str] | None = None) -> None:
    """Run ``splatseed VERB ...``; exits with 2 when the input is at fault."""
    words = sys.argv[1:] if arguments is None else arguments
    _open_closed_streams()
    _show_log()
    _print_any_name()
    _let_threads_sleep()
    try:
        _act(words)
        sys.stdout.flush()
    except OSError as error:
        _fail_of_system(error, asks_help=True)


def _act(words: list[str]) -> None:
    if not words or words[0] in {"-h", "--help"}:
        _print_help()
        return
    if words[0] in {"-V", "--version"}:
        OUT.print(f"splatseed {version('splatseed')}")
        return
    if words[0] == "--completion":
        _print_completion(words[1:])
        return
    if words[0] not in VERBS:
        meant = did_you_mean(words[0], [*VERBS, *OF_ITSELF])
        _fail(
            f"expected a verb ({', '.join(VERBS)}); found {words[0]!r}. "
            f"{meant}Run splatseed --help to see what each does."
        )
    _run(words[0], words[1:])


def _print_completion(words: list[str]) -> None:
    from splatseed.commands.completion import completion_script  # noqa: PLC0415  (loads every verb)

    try:
        OUT.print(completion_script(words, list(VERBS)), end="", soft_wrap=True)
    except SplatseedError as error:
        _fail(str(error))


def _run(verb: str, words: list[str]) -> None:
    try:
        # Import only this verb: --help must not wait for Numba.
        with _termination_raised():
            import_module(f"splatseed.commands.{verb}").run(words)
            sys.stdout.flush()
    except (ParameterError, ReconstructionError) as error:
        _fail(_spelled(error, verb, words))
    except SplatseedError as error:
        _fail(str(error))
    except MemoryError as error:
        _fail(
            f"expected enough memory; found {str(error) or 'none left'}. "
            "Ask for fewer points, or close other programs."
        )
    except OSError as error:
        asks_help = any(word.startswith(("-h", "--help")) for word in words)
        _fail_of_system(error, asks_help=asks_help)
    except KeyboardInterrupt as stop:
        kept = " ".join(getattr(stop, "__notes__", ()))
        told = f". {kept}" if kept else "; nothing was left half-written"
        ERR.print(f"\ninterrupted{told}", soft_wrap=True)
        sys.exit(exit_code(stop))


def _fail_of_system(error: OSError, *, asks_help: bool) -> NoReturn:
    """Exit for an error of the system; quietly if a reader of the help has read enough."""
    if isinstance(error, BrokenPipeError) and asks_help:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # or Python reports it once more at exit
        sys.exit(1)  # as Rich does
    where = f" at {error.filename}" if error.filename else ""
    _fail(
        "expected to read the input and write the output; found"
        f" {error.strerror or type(error).__name__}{where}. Check the disk and the path."
    )


def _spelled(error: SplatseedError, verb: str, words: list[str]) -> str:
    """The error with parameters named as the verb's options."""
    from splatseed.commands.spelling import in_options  # noqa: PLC0415  (loads tyro)

    reports = verb == "bench" and words[:1] in (["report"], ["compare"])
    return str(error) if reports else in_options(str(error), verb)


def _open_closed_streams() -> None:
    """Give a stream that the shell closed (``>&-``) somewhere to go; Python has None for it."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            stream = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115  (for good)
            setattr(sys, name, stream)


@contextmanager
def _termination_raised() -> Iterator[None]:
    """Have SIGTERM raise an exception, so that half-written files are removed.

    The previous handler is restored afterwards.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(number: int, frame: FrameType | None) -> None:  # noqa: ARG001  (signal's)
    raise Termination


def _print_any_name() -> None:
    """Print file names that are not valid Unicode escaped, as Python does on stderr."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")


class _Notes(logging.Handler):
    """Shows what splatseed logs as notes on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        """Show one record."""
        ERR.print(f"note: {visible(record.getMessage())}", soft_wrap=True)


def _show_log() -> None:
    log = logging.getLogger("splatseed")
    if not any(isinstance(each, _Notes) for each in log.handlers):
        log.addHandler(_Notes())


def _let_threads_sleep() -> None:
    """Have idle threads sleep rather than spin; PyTorch's and Numba's OpenMP read this on loading.

    Each has its own pool of threads. If they spin, they take the cores from each other: on a busy
    machine a training step took 5 to 20 times as long.
    """
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")


def _fail(message: str) -> NoReturn:
    """Print one error on stderr and exit with 2."""
    _forget_output()
    ERR.print("error:", style="bold red", end=" ")
    ERR.print(visible(" ".join(message.splitlines())), soft_wrap=True)
    sys.exit(2)


def _forget_output() -> None:
    """Stop writing to a full or closed output, or Python would complain at exit."""
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123, SIM115  (to the end)


def _print_help() -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    for verb, does in VERBS.items():
        table.add_row(f"  {verb}", does)
    OUT.print("usage: splatseed VERB [options]\n")
    OUT.print("Better seeds for 3D Gaussian Splatting.\n")
    OUT.print(table)
    OUT.print("\nsplatseed VERB --help shows a verb's options, splatseed -V the version.")
