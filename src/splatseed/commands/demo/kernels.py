"""The demo's kernels, compiled by a second process while the first one makes photographs.

Notation: a *part* is compiled in one go: what one method needs, or what training needs. A part is
*claimed* by the process that creates the file of its name, and only one can; ``PART.done`` says
that it is compiled. The second process compiles by running the demo on a small capture; the first
finds the machine code in Numba's cache. Promise: no part is compiled twice, nobody waits for a
process that has ended, and results do not depend on it. It starts at the first compilation, so it
does not start if everything is compiled already.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib import invalidate_caches
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from splatseed.commands.demo.methods import SHOWN, upsample_by
from splatseed.console import StageClock
from splatseed.kernels.compilation import watched
from splatseed.process.tasks import Child

TRAINING = "training"
PARTS = (SHOWN, "voronoi", "spline")
"""What the second process compiles, in this order; training as early as possible after the
first."""
SIZE = {"num_views": 8, "width": 96, "height": 72}
POLL = 0.05
"""Seconds between checks of the other process's progress."""


@contextmanager
def kernels_ahead(*, training: bool) -> Iterator[KernelsAhead]:
    """Have another process compile while the block runs, from the first compilation on.

    Args:
        training: Whether it also compiles what training needs, once PyTorch is installed.
    """
    with tempfile.TemporaryDirectory(prefix="splatseed-", ignore_cleanup_errors=True) as folder:
        ahead = KernelsAhead(Path(folder), (SHOWN, TRAINING, *PARTS[1:]) if training else PARTS)
        try:
            with watched(ahead.start):
                yield ahead
        finally:
            ahead.stop()


class KernelsAhead:
    """The second process, as the first sees it.

    Args:
        folder: Where both record what they compile.
        parts: What it compiles.
    """

    def __init__(self, folder: Path, parts: Sequence[str]) -> None:
        self._folder = folder
        self._parts = parts
        self._child: Child | None = None

    def start(self, begins: bool = True) -> None:
        """Start the process, unless it has been started."""
        if begins and self._child is None:
            self._child = Child(log=tempfile.TemporaryFile())  # noqa: SIM115  (the child closes it)
            self._child.start(compile_parts, str(self._folder), *self._parts)

    def wait_for(self, part: str) -> None:
        """Return when the other process is not compiling ``part``: done, or never going to."""
        if self._child is None or _claim(self._folder, part):
            return
        while self._child.process.poll() is None and not _done(self._folder, part).exists():
            time.sleep(POLL)

    def last_first(self, methods: Sequence[str]) -> list[str]:
        """The methods in an order in which the two processes conflict least."""
        return sorted(methods, key=lambda name: PARTS[::-1].index(name) + 1 if name in PARTS else 0)

    def stop(self) -> None:
        """End the process, whatever it is doing."""
        if self._child is not None:
            self._child.close()


def wait(ahead: KernelsAhead, part: str, clock: StageClock) -> None:
    """Wait for what the other process is compiling, and count that as compilation."""
    clock.begin_compilation()
    ahead.wait_for(part)
    clock.end_compilation()


def compile_parts(folder: str, *parts: str) -> None:
    """Compile parts by running a small demo; the second process runs this.

    Args:
        folder: Where parts are claimed.
        parts: What to compile.
    """
    from splatseed.synthetic import make_capture, write_capture  # noqa: PLC0415  (imports Numba)

    place = Path(folder)
    scene = write_capture(make_capture(0, **SIZE), place / "small" / "scene")
    waiting = list(parts)
    while waiting:
        part = next((each for each in waiting if each != TRAINING or _has_pytorch()), None)
        if part is None:  # a package may still be installing
            time.sleep(10 * POLL)
            continue
        waiting.remove(part)
        if _claim(place, part):
            with suppress(Exception):  # the demo itself will hit and report it
                _compile(part, scene)
            _done(place, part).touch()


def _compile(part: str, path: Path) -> None:
    from splatseed.io import find_depths, load_scene, write_scene  # noqa: PLC0415  (loads with its use)
    from splatseed.view.clouds import preview_pair  # noqa: PLC0415  (loads with its use)

    if part == TRAINING:
        _train(path)
        return
    scene = load_scene(path)
    scene = scene.replace(depths=find_depths(scene, path))
    cloud = upsample_by(part, scene, 2.0, 0)
    if part == SHOWN:
        write_scene(scene.replace(points=cloud), path.with_name("shown"))
        preview_pair(scene, cloud, path.with_name("preview.png"), title=part)


def _train(scene: Path) -> None:
    from splatseed.commands.demo.training import Arm, train_arm  # noqa: PLC0415  (loads with its use)
    from splatseed.train.settings import TrainSettings  # noqa: PLC0415  (loads with its use)

    arm = Arm("", scene, scene.with_name("run"))
    train_arm(arm, TrainSettings(cap_max=2000, max_steps=4), StageClock())


def _has_pytorch() -> bool:
    """Whether training's packages are completely installed."""
    invalidate_caches()
    try:
        for package in ("torch", "gsplat", "torchmetrics"):
            version(package)  # from what pip writes last
    except PackageNotFoundError:
        return False
    return True


def _claim(folder: Path, part: str) -> bool:
    """Whether this process is the one to compile ``part``."""
    try:
        os.close(os.open(folder / part, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return False
    return True


def _done(folder: Path, part: str) -> Path:
    return folder / f"{part}.done"
