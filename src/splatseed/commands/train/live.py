"""``splatseed train --view``: a run that browsers can watch while it trains."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatseed.console import OUT
from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.requirements import require

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.train.run import TrainingRun
    from splatseed.view.server import TrainingViewer

HOST = "127.0.0.1"
PORT = 8080


@dataclass(frozen=True)
class Watch:
    """The browsers that watch, if any may."""

    viewer: TrainingViewer | None = None

    @property
    def kept(self) -> bool:
        """Whether a browser stopped the run early, to keep its result."""
        return self.viewer is not None and self.viewer.kept

    def also(self, show: Callable[[int], None]) -> Callable[[int], None]:
        """A function that shows the steps done here, and in the browsers."""
        viewer = self.viewer
        if viewer is None:
            return show

        def both(step: int) -> None:
            show(step)
            viewer.on_step(step)

        return both


def view_port() -> int:
    """The port to serve on: the usual one if it is free.

    Raises:
        MissingDependencyError: viser is absent.
    """
    require("viser")
    from splatseed.view.server import free_port  # noqa: PLC0415  (imports PyTorch)

    try:
        return free_port(HOST, PORT)
    except ParameterError:
        return free_port(HOST, 0)


@contextmanager
def watched(training: TrainingRun, scene: Path, port: int | None) -> Iterator[Watch]:
    """Serve the run while the block runs; nothing without a port."""
    if port is None:
        yield Watch()
        return
    from splatseed.view.server import TrainingViewer  # noqa: PLC0415  (imports PyTorch)

    posed = training.folder.scene  # there is one if poses were refined
    loaded = load_scene(posed if posed.is_dir() else scene, require_points=False)
    viewer = TrainingViewer(training, loaded, scene.name or str(scene), HOST, port)
    OUT.print(f"  -> watch it at http://localhost:{port}")
    OUT.file.flush()
    try:
        yield Watch(viewer)
    finally:
        viewer.close()
