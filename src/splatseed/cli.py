"""Run a verb; print an error as one line, with exit code 2."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import NoReturn

from rich.table import Table

from splatseed.console import (
    OUT,
    print_message,
    print_report,
    session,
    show_extraction,
    with_options,
)
from splatseed.errors import SplatseedError
from splatseed.requirements import version_of
from splatseed.runtime.environment import set_thread_defaults
from splatseed.runtime.interruption import Termination, exit_code
from splatseed.text import did_you_mean, visible

VERBS = {
    "upsample": "Add points to a scene and write it for any 3DGS trainer.",
    "train": "Train 3D Gaussians on a scene, on a GPU or on the CPU.",
    "evaluate": "Score a trained model: PSNR, SSIM, FLIP, LPIPS.",
    "export": "Write a trained model as .ply, .spz, .sog, .splat; crop, thin it.",
    "view": "Look at scenes and models in the browser.",
    "flight": "Make a video of a flight through a trained model, or pictures.",
    "bench": "Compare methods by training: many runs, resumable, then a report.",
    "depth": "Make depth maps of the photographs, by a network or by stereo.",
    "info": "Show what is in a scene or a model, and what is wrong with it.",
    "sfm": "Make a scene from photographs (pycolmap).",
    "undistort": "Take lens distortion out of a scene (pycolmap).",
    "demo": "Make a small scene, upsample it by every method, measure, train.",
}
COMPLETION = "--tyro-print-completion"


def main(arguments: list[str] | None = None) -> None:
    """Run ``splatseed VERB ...``; docs/program.md has the exit codes."""
    words = sys.argv[1:] if arguments is None else arguments
    set_thread_defaults()
    with session():
        _run(words)


def _run(words: list[str]) -> None:
    """Run a verb and print what it reports, or its error."""
    try:
        with _termination_raised(), show_extraction():
            _run_verb(words)
            sys.stdout.flush()
    except SplatseedError as error:
        _fail(str(error))
    except MemoryError as error:
        _fail(
            f"expected enough memory; found {str(error) or 'none left'}. "
            "Ask for fewer points, or close other programs."
        )
    except RuntimeError as error:
        if not _ends_gpu_memory(error):
            raise
        _fail(
            "expected enough memory on the GPU; found none left. Use smaller photographs "
            "(--data-factor) or fewer Gaussians, close other programs on the GPU, or pass "
            "--backend cpu if the verb has it."
        )
    except BrokenPipeError:  # the reader closed the pipe
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # or Python reports it once more at exit
        sys.exit(1)
    except OSError as error:
        where = f" at {error.filename}" if error.filename else ""
        found = f"{error.strerror or type(error).__name__}{where}"
        _fail(f"expected to read the input and write the output; found {found}. Check the disk.")
    except KeyboardInterrupt as stop:
        kept = " ".join(getattr(stop, "__notes__", ()))
        state = f". {kept}" if kept else "; no incomplete output was left"
        print_message(f"\ninterrupted{state}", logging.WARNING)
        sys.exit(exit_code(stop))


def _run_verb(words: list[str]) -> None:
    verb = words[0] if words else "--help"
    if verb in VERBS:
        # Only this verb is imported, so that --help does not wait for Numba.
        try:
            import_module(f"splatseed.commands.{verb}").run(words[1:])
        except SystemExit:  # with another exit code than 0, perhaps with results
            print_report()
            raise
        print_report()
    elif verb in {"-h", "--help"}:
        _print_help()
    elif verb in {"-V", "--version"}:
        OUT.print(f"splatseed {version_of('splatseed')}")
    elif verb.partition("=")[0] == COMPLETION:
        import tyro  # noqa: PLC0415  (takes a while to load)

        from splatseed.commands.options import CONFIG, with_reporting  # noqa: PLC0415  (likewise)

        modules = {verb: import_module(f"splatseed.commands.{verb}") for verb in VERBS}
        verbs = {verb: module.Options for verb, module in modules.items()}
        verbs["upsample"] = modules["upsample"].full_options()
        verbs = {verb: with_reporting(options) for verb, options in verbs.items()}
        tyro.extras.subcommand_cli_from_dict(verbs, prog="splatseed", args=words, config=CONFIG)
    else:
        meant = did_you_mean(verb, [*VERBS, "--help", "--version", COMPLETION])
        _fail(
            f"expected a verb ({', '.join(VERBS)}); found {verb!r}. "
            f"{meant}Run splatseed --help to see what each does."
        )


@contextmanager
def _termination_raised() -> Iterator[None]:
    """Raise an exception on SIGTERM while the block runs, so that incomplete files are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def terminate(*_: object) -> NoReturn:
        raise Termination

    before = signal.signal(signal.SIGTERM, terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _ends_gpu_memory(error: RuntimeError) -> bool:
    torch = sys.modules.get("torch")  # loaded, if it raised the error
    return torch is not None and isinstance(error, torch.cuda.OutOfMemoryError)


def _fail(message: str) -> NoReturn:
    """Print an error on stderr, with options for the library's arguments, and exit with 2."""
    if sys.exc_info()[0] is not None:
        print_message(traceback.format_exc(), logging.DEBUG)
    text = visible(with_options(" ".join(message.splitlines())))
    print_message(text, logging.ERROR, "error")
    sys.exit(2)


def _print_help() -> None:
    table = Table(show_header=False, box=None, pad_edge=False)
    for verb, does in VERBS.items():
        table.add_row(f"  {verb}", does)
    OUT.print("usage: splatseed VERB [options]\n")
    OUT.print("Better seeds for 3D Gaussian Splatting.\n")
    OUT.print(table)
    OUT.print("\nsplatseed VERB --help shows a verb's options, splatseed -V the version,")
    OUT.print(f"splatseed {COMPLETION} bash (or zsh) a script that completes options.")
