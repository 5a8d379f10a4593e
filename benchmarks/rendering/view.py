"""How soon the viewer shows a first picture, and how many per second after it, on the CPU.

Notation: a *frame* is drawn, encoded as JPEG and handed to the browser's connection, on the loop
that the viewer runs for each browser; the browser itself, which would take the same cores here, is
not started. Promise: the loop and the pictures are the viewer's own; kernels are compiled before.
Each table is Markdown.
"""

from __future__ import annotations

import dataclasses
import io
import os
import threading
import time
from dataclasses import dataclass

import numpy as np
import tyro
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.rendering.splats import make_workload
from PIL import Image

from splatseed.camera import Camera
from splatseed.photos.view import View
from splatseed.splat.training_frame import training_frame
from splatseed.viewer.flights import smooth_path
from splatseed.viewer.models import ViewerItem
from splatseed.viewer.pictures import Entry
from splatseed.viewer.session import FrameLoop

QUALITY = 70


@dataclass(frozen=True)
class Options:
    """Time the viewer's frames on a made room."""

    gaussians: int = 200_000
    """How many."""
    size: tuple[int, int] = (800, 600)
    """The browser's canvas, pixels."""
    seconds: float = 5.0
    """How long the camera moves."""
    repeats: int = 5
    """How often the first frame is timed."""


class Stage:
    """A browser's place: a camera that moves along a path, and pictures that are counted."""

    def __init__(self, entry: Entry, path: list[View]) -> None:
        self.entry, self.path = entry, path
        self.began = time.perf_counter()
        self.sent: list[tuple[float, float]] = []
        self.arrived = threading.Event()

    def draw(self, scale: float) -> int:
        """What ``Session`` does for a frame, but for the socket."""
        at = int((time.perf_counter() - self.began) * 60) % len(self.path)
        canvas = _scaled(self.path[at], scale)
        picture, _ = self.entry.draw("Gaussians", canvas, None, fast=scale < 1)
        assert picture is not None  # noqa: S101  (it is a model)
        Image.fromarray(picture).save(io.BytesIO(), "JPEG", quality=QUALITY)
        self.sent.append((time.perf_counter() - self.began, scale))
        self.arrived.set()
        return canvas.width * canvas.height


def _scaled(view: View, scale: float) -> View:
    size = (round(scale * view.width), round(scale * view.height))
    K = np.diag([size[0] / view.width, size[1] / view.height, 1.0]) @ view.K
    return dataclasses.replace(view, camera=Camera(K, *size, view.cam_from_world))


def _first_frame(entry: Entry, path: list[View]) -> tuple[float, float]:
    """Seconds to the first picture and to the first full one."""
    stage = Stage(entry, path[:1])
    loop = FrameLoop(stage.draw)
    loop.change()
    while not stage.sent or stage.sent[-1][1] < 1:
        time.sleep(0.002)
    loop.close()
    return stage.sent[0][0], stage.sent[-1][0]


def _moving(entry: Entry, path: list[View], seconds: float) -> tuple[float, float]:
    """Frames a second while the camera moves, and their mean size over the canvas's."""
    stage = Stage(entry, path)
    loop = FrameLoop(stage.draw)
    while time.perf_counter() - stage.began < seconds:
        loop.change()
        time.sleep(1 / 60)
    loop.close()
    frames = [each for each in stage.sent if each[0] > 1.0]  # it learns what a pixel takes first
    return len(frames) / (seconds - 1.0), float(np.mean([scale for _, scale in frames]))


def main(options: Options) -> None:
    """Print the tables."""
    warn_if_busy()
    workload = make_workload(options.gaussians, *options.size)
    item = ViewerItem("room", None, workload.gaussians)
    entry = Entry(item, training_frame(workload.views))
    path = smooth_path(workload.views, 600, options.size)
    for fast in (True, False):  # compiles, and prepares what is kept
        entry.draw("Gaussians", _scaled(path[0], 0.3), None, fast=fast)
    began = os.times()
    firsts = [_first_frame(entry, path) for _ in range(options.repeats)]
    fps, scale = _moving(entry, path, options.seconds)
    used = os.times()
    cpu = used.user + used.system - began.user - began.system
    first, full = (np.median([each[i] for each in firsts]) for i in (0, 1))
    print(
        f"{describe()}\n\n{options.gaussians:,} Gaussians, {options.size[0]} x {options.size[1]}\n"
    )
    rows = [
        ("first picture, s", f"{first:.2f}"),
        ("first full picture, s", f"{full:.2f}"),
        ("pictures a second while moving", f"{fps:.1f}"),
        ("their mean size", f"{scale:.2f} of the canvas"),
        ("CPU time of all this, s", f"{cpu:.1f} in {used.elapsed - began.elapsed:.1f} s"),
    ]
    print(table(("", "measured"), rows))


if __name__ == "__main__":
    main(tyro.cli(Options))
