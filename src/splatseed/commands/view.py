"""``splatseed view``: scenes, seeds and trained models in the browser."""

from __future__ import annotations

import socket
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatseed.commands.options import parse_options
from splatseed.console import OUT, print_note, print_pairs, stage_display
from splatseed.io.load import check_exists, is_scene
from splatseed.requirements import require
from splatseed.runtime.interruption import Termination, exit_code
from splatseed.splat.formats import SUFFIXES
from splatseed.text import counted, visible
from splatseed.training.folder import RunFolder
from splatseed.training.settings import Backend

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.viewer.models import Shown

MOST_OPENED = 12
LOCAL = {"127.0.0.1", "localhost"}


@dataclass(frozen=True)
class Options:
    """Look at a scene, its seeds or a trained model in the browser, or at two side by side."""

    what: Annotated[Path, tyro.conf.Positional]
    """A scene, a run folder, a file of Gaussians or points, or a folder that holds several of
    these."""
    compare: Path | None = None
    """Show this one beside it, from the same camera."""
    scene: Path | None = None
    """The scene a file of Gaussians belongs to; a run knows its own."""
    host: str = "127.0.0.1"
    """The address to listen on: this machine alone, or 0.0.0.0 for all that can reach it."""
    port: int = 8080
    """The port to listen on; 0 for any free one."""
    backend: Backend = "auto"
    """Where to render; auto takes a GPU if PyTorch sees one."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "view", arguments)
    require("torch", "viser")
    from splatseed.training.device import pick_device
    from splatseed.viewer.models import stage_frame
    from splatseed.viewer.pictures import Entry
    from splatseed.viewer.server import Viewer, free_port

    for path in filter(None, (options.what, options.compare)):
        check_exists(path)  # a slip in a path is told before a port that is taken
    port = free_port(options.host, options.port)
    with stage_display() as clock:
        clock("read", 0.0)
        opened, beside = _opened(options)
        device, frame = pick_device(options.backend, clock), stage_frame(opened[0])
        entries = [Entry(shown, frame, device) for shown in opened]
        second = None if beside is None else entries[beside]
        viewer = Viewer(entries, options.host, port, second)
        clock("prepare", 0.0)
        entries[0].warm_up()
    _announce(options, port, opened, beside)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt as stop:
        OUT.print("stopped")
        if isinstance(stop, Termination):  # Ctrl-C is how a viewer ends
            sys.exit(exit_code(stop))
    finally:
        viewer.stop()


def _opened(options: Options) -> tuple[list[Shown], int | None]:
    """What to show, under names that tell them apart; and which is compared with the first."""
    from splatseed.viewer.models import names_of, open_shown

    paths = {path.resolve(): path for path in _within(options.what)}
    beside = None
    if options.compare is not None:
        compared = {path.resolve(): path for path in _within(options.compare)}
        paths |= compared  # one that is shown already is not shown twice
        beside = list(paths).index(next(iter(compared)))
    named = zip(names_of(list(paths.values())), paths.values(), strict=True)
    return [replace(open_shown(path, options.scene), name=name) for name, path in named], beside


def _within(path: Path) -> list[Path]:
    """The path itself, or the finished runs, scenes and models in a folder that is neither."""
    if not path.is_dir() or RunFolder(path).is_run or is_scene(path):
        return [path]
    shown = [each for each in sorted(path.iterdir()) if _is_shown(each)]
    if len(shown) > MOST_OPENED:
        print_note(
            f"{visible(path)} holds {len(shown)}; shown are the first {MOST_OPENED} by name. "
            "To see others, give their paths."
        )
    return shown[:MOST_OPENED] or [path]


def _is_shown(path: Path) -> bool:
    """Whether something in a folder is a finished run, a scene or a model."""
    if path.is_file():
        return path.name.lower().endswith(tuple(SUFFIXES))
    folder = RunFolder(path)
    return folder.gaussians.is_file() if folder.is_run else is_scene(path)


def _announce(options: Options, port: int, opened: list[Shown], beside: int | None) -> None:
    """Say where to look; flushed, because whoever started us may be waiting for it."""
    host = "localhost" if options.host in LOCAL | {"0.0.0.0"} else options.host  # noqa: S104  (compared, not bound)
    rows = []
    for shown in opened:
        parts = [] if shown.gaussians is None else [counted(len(shown.gaussians), "Gaussian")]
        if shown.scene is not None:
            parts.append(counted(len(shown.scene.points), "point"))
            parts.append(counted(len(shown.scene.images), "image"))
        rows.append((shown.name, ", ".join(parts)))
    if beside is not None:
        rows.append(("side by side", f"{opened[0].name} left, {opened[beside].name} right"))
    print_pairs("splatseed view", rows)
    for note in (note for shown in opened for note in shown.notes):
        print_note(note)
    commands = [("open in a browser", f"http://{host}:{port}")]
    if options.host in LOCAL:
        tunnel = f"ssh -L {port}:localhost:{port} {socket.gethostname()}"
        commands.append(("from elsewhere, first", tunnel))
    print_pairs("next", [*commands, ("stop", "Ctrl-C")])
    OUT.file.flush()
