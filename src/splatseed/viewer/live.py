"""Pictures that follow a browser's camera: coarse while it moves, full when it is still.

Notation: a *frame* is one picture sent; the scale of a frame is its size divided by the canvas's.
Promise: the newest camera is drawn, never a queue of old ones; a browser that disconnects ends only
its own thread.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np

MOVING_SECONDS = 0.12
"""Seconds a frame may take while the camera moves."""
STILL_AFTER = 0.2
"""Seconds without movement after which the full picture is drawn."""
LEAST_SCALE, FIRST_SCALE = 0.12, 0.3
"""Coarsest scale of a frame, and the scale before any frame has been timed."""
CLOSE_SECONDS = 2.0
"""Seconds to wait for the frame being drawn."""
MEMORY = 0.5
"""Weight of the latest frame in the running estimate of the cost per pixel."""


class FrameLoop:
    """Draws a frame after each call of ``change``.

    Args:
        draw: Draws and sends a picture at a scale; returns the number of pixels drawn, 0 for none.
    """

    def __init__(self, draw: Callable[[float], int]) -> None:
        self._draw = draw
        self._changed = threading.Event()
        self._closed = False
        self._pixel_seconds: float | None = None
        self._full_pixels = 1.0
        self.frames = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def change(self) -> None:
        """The camera moved, or something else is shown."""
        self._changed.set()

    def close(self) -> None:
        """End the loop once the current frame is finished."""
        self._closed = True
        self._changed.set()
        self._thread.join(CLOSE_SECONDS)

    def _run(self) -> None:
        while True:
            self._changed.wait()
            if self._closed:
                return
            self._changed.clear()
            scale = self._scale()
            self._frame(scale)
            if scale < 1 and not self._changed.wait(STILL_AFTER):
                self._frame(1.0, learn=False)

    def _scale(self) -> float:
        """The scale at which a frame just meets its time budget."""
        if self._pixel_seconds is None:
            return FIRST_SCALE
        affordable = MOVING_SECONDS / self._pixel_seconds / self._full_pixels
        # Pixels go with the square of the scale.
        return float(np.clip(np.sqrt(affordable), LEAST_SCALE, 1.0))

    def _frame(self, scale: float, *, learn: bool = True) -> None:
        began = time.perf_counter()
        pixels = self._draw(scale)
        if not pixels:
            return
        self.frames += 1
        self._full_pixels = pixels / scale**2
        if not learn:  # a full frame draws all Gaussians, a coarse one only the most visible
            return
        took = (time.perf_counter() - began) / pixels
        before = took if self._pixel_seconds is None else self._pixel_seconds
        self._pixel_seconds = MEMORY * took + (1 - MEMORY) * before
