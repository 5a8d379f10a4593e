"""Watching a run train: its renders in the browser, its progress, pausing, and stopping early.

Promise: the training thread itself draws, between two steps, so nothing changes under a render; the
training steps are the same as without a viewer; time spent on browsers does not count as training.
"""

from __future__ import annotations

import queue
import signal
import time
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from typing import Any

import numpy as np
from jaxtyping import Float32

from splatseed.scene import Image, Scene
from splatseed.splat.gaussians import training_frame
from splatseed.train.run import TrainingRun
from splatseed.viewer.pictures import Drawn, Entry
from splatseed.viewer.session import Session
from splatseed.viewer.shown import Shown
from splatseed.viewer.viewer import Viewer
from splatseed.views.view import View, poses_of

REFRESH_SECONDS = 2.0
"""Seconds between pictures that are sent unasked."""
PATIENCE = 60.0
"""Seconds that a picture waits for the current step."""
PAUSED_POLL = 0.05
ENDED = "The training has ended: look at the run with splatseed view."


class _LiveRenderer:
    """Renders the Gaussians as they are now."""

    def __init__(self, run: TrainingRun, entry: Entry) -> None:
        self._run, self._entry = run, entry

    def color(self, view: View) -> Float32[np.ndarray, "H W 3"]:
        """A view of the world, in [0, 1]."""
        image = self._run.trainer.render(self._entry.frame.view(view))
        return np.asarray(image.clamp(0, 1).cpu().numpy())


class _LiveEntry(Entry):
    """A run's scene and its current Gaussians, drawn by the thread that calls ``serve``."""

    def __init__(self, shown: Shown, run: TrainingRun) -> None:
        assert shown.scene is not None  # noqa: S101  (a run has a scene)
        train_images = shown.scene.split(shown.test_every)[0]
        super().__init__(shown, training_frame(poses_of(train_images)))
        self.renderer = _LiveRenderer(run, self)  # type: ignore[assignment]  # has what Entry calls
        self._asked: queue.SimpleQueue[tuple[Future[Drawn], Callable[[], Drawn]]] = (
            queue.SimpleQueue()
        )
        self._painters.pop("depth", None)
        self._open = True

    @property
    def has_model(self) -> bool:
        return True

    def draw(self, kind: str, canvas: View, at: Image | None, *, quick: bool = False) -> Drawn:
        """Have the training thread draw, and wait for it."""
        del quick  # the Gaussians change from step to step
        if not self._open:
            return None, ENDED
        future: Future[Drawn] = Future()
        draw = super().draw
        self._asked.put((future, lambda: draw(kind, canvas, at)))
        try:
            return future.result(PATIENCE)
        except (TimeoutError, CancelledError):
            return None, ENDED if not self._open else "The current step takes long."

    def serve(self, wait: float = 0.0) -> None:
        """Draw what was asked for, waiting up to ``wait`` seconds for the first request."""
        while True:
            try:
                future, draw = self._asked.get(timeout=wait) if wait else self._asked.get_nowait()
            except queue.Empty:
                return
            wait = 0.0
            try:
                future.set_result(draw())
            except Exception as error:  # noqa: BLE001  (told to whoever asked; training goes on)
                future.set_exception(error)

    def close(self) -> None:
        """Stop answering requests."""
        self._open = False
        while not self._asked.empty():
            self._asked.get()[0].cancel()


class TrainingViewer(Viewer):
    """Serves a run while it trains.

    Args:
        run: The run.
        scene: Its scene.
        name: What to call it.
        host: The address to listen at.
        port: The port that ``free_port`` returned.
    """

    def __init__(self, run: TrainingRun, scene: Scene, name: str, host: str, port: int) -> None:
        config = {"test_every": run.settings.test_every, "data_factor": run.settings.data_factor}
        shown = Shown(name, run.folder.path, scene, None, config)
        self._run = run
        self._live = _LiveEntry(shown, run)
        self._paused, self.kept = False, False
        self._panels: dict[int, tuple[Session, Any, Any]] = {}
        self._next = 0.0
        super().__init__([shown], host, port, entries=[self._live])

    def greet(self, session: Session) -> None:
        """Add the run's progress, a pause and a stop button."""
        gui = session.gui
        with gui.add_folder("Training", order=-1.0):
            numbers = gui.add_markdown(self._numbers())
            pause = gui.add_checkbox("Pause", self._paused)
            stop = gui.add_button("Stop and keep")
        pause.on_update(lambda _: self.pause(on=pause.value))
        stop.on_click(lambda _: self.stop_and_keep())
        self._panels[id(session)] = (session, numbers, pause)

    def pause(self, *, on: bool) -> None:
        """Pause after the current step, or resume."""
        self._paused = on
        for _, _, box in list(self._panels.values()):
            if box.value != on:
                box.value = on

    def stop_and_keep(self) -> None:
        """End after the current step, and finish the run as it is."""
        self.kept = True

    def on_step(self, step: int) -> None:
        """Between two steps, draw for the browsers, wait while paused, and stop on request."""
        del step
        if not self.sessions and not self.kept and not self._paused:
            return
        watch = self._run.state.watch
        watch.stop()
        self._refresh()
        self._live.serve()
        while self._paused and not self.kept and not self._interrupted():
            self._live.serve(PAUSED_POLL)
        watch.start()
        if self.kept:
            signal.raise_signal(signal.SIGINT)  # like Ctrl-C: the trainer stops after the step

    def close(self) -> None:
        """Disconnect all browsers."""
        self._live.close()
        self.stop()

    @staticmethod
    def _interrupted() -> bool:
        handler = signal.getsignal(signal.SIGINT)
        return bool(getattr(handler, "requested", False))

    def _refresh(self) -> None:
        """Update the numbers and ask for new pictures, now and then."""
        if time.monotonic() < self._next:
            return
        looking = self.sessions
        for key, (session, numbers, _) in list(self._panels.items()):
            if session in looking:
                numbers.content = self._numbers()
                session.refresh()
            else:
                del self._panels[key]
        self._next = time.monotonic() + REFRESH_SECONDS

    def _numbers(self) -> str:
        state, settings = self._run.state, self._run.settings
        lines = [
            f"**step {state.step:,}** of {settings.max_steps:,}",
            f"{len(state.params['means']):,} Gaussians",
        ]
        if state.records:
            last = state.records[-1]
            tests = (r.test_psnr for r in reversed(state.records) if r.test_psnr is not None)
            tested = next(tests, None)
            lines.append(f"PSNR {last.train_psnr:.2f} dB in training")
            lines += [] if tested is None else [f"PSNR **{tested:.2f} dB** on test views"]
            lines.append(f"loss {last.loss:.4f}")
        return "  \n".join([*lines, f"{state.watch.seconds:.0f} s of training"])
