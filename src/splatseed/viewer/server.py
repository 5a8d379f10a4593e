"""The viewer's server for any number of browsers, and the viewer of a run while it trains.

Promise: the server listens on the given host and port and uses no other network; a taken port is an
error. During training the training thread draws, between two steps, so Gaussians do not change
during a render and training steps are the same as without a viewer; time spent on browsers does not
count as training.
"""

from __future__ import annotations

import io
import logging
import queue
import signal
import socket
import threading
import time
import warnings
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from contextlib import redirect_stdout
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32, Float64

from splatseed.camera import Camera
from splatseed.errors import ParameterError
from splatseed.photos.upright import quarter_turns, turned, up_direction
from splatseed.photos.view import View
from splatseed.photos.viewpoint import choose_camera, choose_image
from splatseed.requirements import require
from splatseed.scene import Image, Scene
from splatseed.splat.training_frame import TrainingFrame
from splatseed.viewer.flights import orbit
from splatseed.viewer.models import ViewerItem
from splatseed.viewer.pictures import Drawn, Entry, fitted_fov, viewer_pose
from splatseed.viewer.session import Session

if TYPE_CHECKING:
    from splatseed.training.run import TrainingRun

STEP_BACK = 0.6  # in the viewer frame, behind the first camera, so that it is visible
REFRESH_SECONDS = 2.0  # between updates of a run's pictures
STEP_TIMEOUT = 60.0  # seconds that a picture waits for a training step
PAUSED_POLL = 0.05  # seconds between checks for requests while a run is paused
ENDED = "The training has ended: open the run with splatseed view."


def free_port(host: str, port: int) -> int:
    """Check that a port can be listened on; 0 finds a free port."""
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            return int(probe.getsockname()[1])
    except (OSError, OverflowError) as error:  # the latter beyond 65535
        raise ParameterError(
            f"to listen on `host={host!r}`, `port={port}`",
            found=getattr(error, "strerror", None) or str(error),
            fix="Pass another `port` (0: any free port); `host='127.0.0.1'` is this machine alone.",
        ) from None


class Viewer:
    """Serves entries on a port from ``free_port``.

    Browsers start at the camera of the first entry that sees most, with ``second`` to the right.

    Raises:
        MissingDependencyError: viser is absent.
    """

    def __init__(
        self, entries: list[Entry], host: str, port: int, second: Entry | None = None
    ) -> None:
        require("viser")
        import viser  # noqa: PLC0415  (of the extra view)

        self.entries, self._second = entries, second
        self._sessions: dict[int, Session] = {}
        self._left = set[int]()  # browsers that disconnected before they got a session
        self._lock = threading.Lock()
        # A browser may disconnect at any moment, which needs no warning.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        # Nor does a request that is no page's: websockets logs each with a traceback.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        with redirect_stdout(io.StringIO()):  # viser prints its own address
            self.server: Any = viser.ViserServer(host, port, label="splatseed", verbose=False)
        self.server.gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="large"
        )
        self._place_camera(entries[0])
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)

    def stop(self) -> None:
        """Close all connections."""
        for session in self.sessions:
            session.close()
        with redirect_stdout(io.StringIO()):
            self.server.stop()

    @property
    def sessions(self) -> list[Session]:
        """The sessions of the connected browsers."""
        with self._lock:
            return list(self._sessions.values())

    def add_controls(self, gui: Any, session: Session) -> None:
        """Add controls for a new browser; for subclasses."""

    def _connect(self, client: Any) -> None:
        session = Session(client, self.entries, self._second)
        self.add_controls(client.gui, session)
        with self._lock:
            if client.client_id not in self._left:
                self._sessions[client.client_id] = session
                return
        session.close()

    def _disconnect(self, client: Any) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
            if session is None:
                self._left.add(client.client_id)
        if session is not None:
            session.close()

    def _place_camera(self, entry: Entry) -> None:
        """Start at the camera that sees most, or outside of the model."""
        scene, frame = entry.item.scene, entry.frame
        if scene is not None and (scene.images or len(scene.points)):
            image = choose_image(scene) if len(scene.points) else scene.images[0]
            turns = quarter_turns(scene.images)
            cameras = [turned(im.camera, n) for im, n in zip(scene.images, turns, strict=True)]
            chosen = scene.images.index(image) if image is not None else 0
            camera = cameras[chosen] if cameras else choose_camera(scene)
            up = up_direction(cameras or [camera])
            # Behind the first camera of a scene, to see the cameras.
            place_camera(self.server, camera, up, frame, 0.0 if entry.has_model else STEP_BACK)
        else:
            outside = orbit([], entry.item.model, 1, (600, 400))[0].camera
            place_camera(self.server, outside, up_direction([]), frame)


def place_camera(
    server: Any,
    camera: Camera,
    up: Float64[np.ndarray, " 3"],
    frame: TrainingFrame,
    step_back: float = 0.0,
) -> None:
    """Start browsers of a viser server at a camera, or some way behind it in the viewer frame."""
    ahead, (_, position) = camera.world_from_cam[:3, 2], viewer_pose(camera, frame)
    position = position - step_back * ahead
    server.scene.set_up_direction(tuple(up.tolist()))
    start = server.initial_camera
    start.position, start.look_at = tuple(position), tuple(position + ahead)
    start.fov, start.near = fitted_fov(camera, 1.5), min(start.near, frame.near)


class _LiveEntry(Entry):
    """Entry of a run's current Gaussians, drawn by the thread that calls ``serve``."""

    def __init__(self, item: ViewerItem, run: TrainingRun) -> None:
        super().__init__(item, run.frame)

        def color(view: View) -> Float32[np.ndarray, "H W 3"]:
            image = run.trainer.render(self.frame.view(view))
            return np.asarray(image.clamp(0, 1).cpu().numpy())

        self.renderer = SimpleNamespace(color=color)  # type: ignore[assignment]  # as Entry calls it
        self._requests = queue.SimpleQueue[tuple[Future[Drawn], Callable[[], Drawn]]]()
        del self._painters["depth"]
        self._open = True

    @property
    def has_model(self) -> bool:
        return True

    def draw(self, kind: str, canvas: View, at: Image | None, *, fast: bool = False) -> Drawn:
        """Let the training thread draw, and wait for it."""
        del fast  # the Gaussians change from step to step
        if not self._open:
            return None, ENDED
        future: Future[Drawn] = Future()
        draw = super().draw
        self._requests.put((future, lambda: draw(kind, canvas, at)))
        try:
            return future.result(STEP_TIMEOUT)
        except (TimeoutError, CancelledError):
            return None, ENDED if not self._open else "The current step is slow."

    def serve(self, wait: float = 0.0) -> None:
        """Draw the requested pictures, waiting up to ``wait`` seconds for the first request."""
        while True:
            try:
                future, draw = (
                    self._requests.get(timeout=wait) if wait else self._requests.get_nowait()
                )
            except queue.Empty:
                return
            wait = 0.0
            try:
                future.set_result(draw())
            except Exception as error:  # noqa: BLE001  (passed to the request; training goes on)
                future.set_exception(error)

    def close(self) -> None:
        """Stop answering requests."""
        self._open = False
        while not self._requests.empty():
            self._requests.get()[0].cancel()


class TrainingViewer(Viewer):
    """Serves a run while it trains, labelled ``name``."""

    def __init__(self, run: TrainingRun, scene: Scene, name: str, host: str, port: int) -> None:
        item = ViewerItem(name, scene, None, run.settings.factor, run.settings.test_every)
        self._run, self._live = run, _LiveEntry(item, run)
        self._paused, self.kept = False, False
        self._panels: list[tuple[Session, Any, Any]] = []
        self._next = 0.0
        super().__init__([self._live], host, port)

    def add_controls(self, gui: Any, session: Session) -> None:
        """Add the run's progress and buttons to pause and stop."""
        with gui.add_folder("Training", order=-1.0):
            numbers = gui.add_markdown(self._numbers())
            pause = gui.add_checkbox("Pause", self._paused)
            stop = gui.add_button("Stop and keep")
        pause.on_update(lambda _: self.pause(on=pause.value))
        stop.on_click(lambda _: self.stop_and_keep())
        self._panels.append((session, numbers, pause))

    def pause(self, *, on: bool) -> None:
        """Pause after the current step, or resume."""
        self._paused = on
        for _, _, box in self._panels:
            if box.value != on:
                box.value = on

    def stop_and_keep(self) -> None:
        """End training after the current step, and keep the result."""
        self.kept = True

    def on_step(self, step: int) -> None:
        """Draw for the browsers between two steps, wait while paused, and stop on request."""
        del step
        if not self.sessions and not self.kept and not self._paused:
            return
        watch = self._run.state.watch
        watch.stop()
        self._refresh()
        self._live.serve()
        handler = signal.getsignal(signal.SIGINT)
        while self._paused and not self.kept and not getattr(handler, "requested", False):
            self._live.serve(PAUSED_POLL)
        watch.start()
        if self.kept:
            signal.raise_signal(signal.SIGINT)  # like Ctrl-C: the trainer stops after the step

    def close(self) -> None:
        """Disconnect all browsers."""
        self._live.close()
        self.stop()

    def _refresh(self) -> None:
        """Update numbers and pictures every ``REFRESH_SECONDS``."""
        if time.monotonic() < self._next:
            return
        connected = self.sessions
        self._panels = [panel for panel in self._panels if panel[0] in connected]
        for session, numbers, _ in self._panels:
            numbers.content = self._numbers()
            session.refresh()
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
