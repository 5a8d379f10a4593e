"""``splatseed view``: scenes, seeds and trained models in the browser."""

from __future__ import annotations

import socket
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatseed.commands.options import parse_options, refuse
from splatseed.console import (
    add_results,
    print_message,
    print_next,
    print_note,
    print_pairs,
    print_report,
    stage_display,
)
from splatseed.findings import Finding
from splatseed.io.load import check_exists, is_scene
from splatseed.requirements import require
from splatseed.runtime.interruption import Termination, exit_code
from splatseed.splat.formats import SUFFIXES
from splatseed.text import counted, visible
from splatseed.training.folder import RunFolder
from splatseed.training.request import ExcludeChoice
from splatseed.training.settings import Backend

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.viewer.models import ViewerItem

MAX_ITEMS = 12
PAGE = ".html"
LOCAL = {"127.0.0.1", "localhost"}


@dataclass(frozen=True)
class Options:
    """View a scene, its seeds or a trained model in the browser, or two side by side."""

    path: Annotated[Path, tyro.conf.Positional]
    """A scene, a run folder, a file of Gaussians or points, or a folder with several of these."""
    compare: Path | None = None
    """A second item to show side by side, from the same camera."""
    scene: Path | None = None
    """The scene of a file of Gaussians; a run has its own."""
    exclude: ExcludeChoice = ()
    """Photographs of the scene to leave out: a name, a pattern such as 'IMG_00*', or a .txt file of
    these."""
    host: str = "127.0.0.1"
    """The address to listen on: this machine alone, or 0.0.0.0 for all that can reach it."""
    port: int = 8080
    """The port to listen on; 0 for any free port."""
    backend: Backend = "auto"
    """Where to render; auto takes a GPU if PyTorch sees one."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "view", arguments)
    require("torch", "viser")
    from splatseed.training.device import pick_device
    from splatseed.viewer.models import viewer_frame
    from splatseed.viewer.pictures import Entry
    from splatseed.viewer.server import Viewer, free_port

    for path in filter(None, (options.path, options.compare)):
        check_exists(path)  # before the port: a wrong path is the more likely mistake
        refuse(
            (path.suffix.lower() == PAGE,
             f"a scene, a run, a file of points or Gaussians, or a folder of these, not {path}",
             "a web page", f"Open it in a browser: {visible(path.resolve().as_uri())}"),
        )  # fmt: skip
    port = free_port(options.host, options.port)
    with stage_display() as clock:
        clock("read", 0.0)
        items, second = _open_items(options)
        device, frame = pick_device(options.backend, clock), viewer_frame(items[0])
        entries = [Entry(item, frame, device) for item in items]
        viewer = Viewer(entries, options.host, port, None if second is None else entries[second])
        clock("prepare", 0.0)
        entries[0].warm_up()
    _announce(options, port, items, second)
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt as stop:
        print_message("stopped")
        if isinstance(stop, Termination):  # Ctrl-C is the usual end
            sys.exit(exit_code(stop))
    finally:
        viewer.stop()


def _open_items(options: Options) -> tuple[list[ViewerItem], int | None]:
    """Read the items, with unique names, and return the index of the item to compare with."""
    from splatseed.viewer.models import open_item, unique_names

    paths = {path.resolve(): path for path in _items_in(options.path)}
    second = None
    if options.compare is not None:
        compared = {path.resolve(): path for path in _items_in(options.compare)}
        paths |= compared
        second = list(paths).index(next(iter(compared)))
    named = zip(unique_names(list(paths.values())), paths.values(), strict=True)
    return [
        replace(open_item(path, options.scene, options.exclude), name=name) for name, path in named
    ], second


def _items_in(path: Path) -> list[Path]:
    """The path itself, or the finished runs, scenes and models in a folder that is neither."""
    if not path.is_dir() or RunFolder(path).is_run or is_scene(path):
        return [path]
    items = [child for child in sorted(path.iterdir()) if _is_item(child)]
    if len(items) > MAX_ITEMS:
        text = f"{visible(path)} has {len(items)} items; the first {MAX_ITEMS} by name are shown."
        fix = "To view others, pass their paths."
        print_note(Finding("items-left-out", text, "info", fix=fix))
    return items[:MAX_ITEMS] or [path]


def _is_item(path: Path) -> bool:
    if path.is_file():
        return path.name.lower().endswith(tuple(SUFFIXES))
    folder = RunFolder(path)
    return folder.gaussians.is_file() if folder.is_run else is_scene(path)


def _announce(options: Options, port: int, items: list[ViewerItem], second: int | None) -> None:
    """Print the items and the address; flushed, as a parent process may wait for it."""
    host = "localhost" if options.host in LOCAL | {"0.0.0.0"} else options.host  # noqa: S104  (compared, not bound)
    rows = []
    for item in items:
        parts = [] if item.gaussians is None else [counted(len(item.gaussians), "Gaussian")]
        if item.scene is not None:
            parts.append(counted(len(item.scene.points), "point"))
            parts.append(counted(len(item.scene.images), "image"))
        rows.append((item.name, ", ".join(parts)))
    if second is not None:
        rows.append(("side by side", f"{items[0].name} left, {items[second].name} right"))
    print_pairs("splatseed view", rows)
    print_note(*(finding for item in items for finding in item.findings))
    url = f"http://{host}:{port}"
    add_results(url=url, items=[name for name, _ in rows[: len(items)]])
    commands = [("open in a browser", url)]
    if options.host in LOCAL:
        tunnel = f"ssh -L {port}:localhost:{port} {socket.gethostname()}"
        commands.append(("from elsewhere, first", tunnel))
    print_next([*commands, ("stop", "Ctrl-C")])
    print_report()
