"""The viewer's server: one page, any number of browsers.

Promise: of the network, only the host and port to listen on are used; a taken port is an error, and
no other port is tried.
"""

from __future__ import annotations

import io
import socket
import threading
import warnings
from contextlib import redirect_stdout
from typing import Any

import numpy as np
import torch

from splatseed.errors import ParameterError
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.splat.gaussians import TrainingFrame, training_frame
from splatseed.viewer.canvas import fitted_fov, stage_pose
from splatseed.viewer.paths import orbit
from splatseed.viewer.pictures import Entry
from splatseed.viewer.renderer import CORE, model_frame
from splatseed.viewer.session import MOST_POINTS, Session
from splatseed.viewer.shown import Shown
from splatseed.views.view import poses_of
from splatseed.views.viewpoint import choose_camera, choose_image

MOST_PORT = 65535
STEP_BACK = 0.6
"""How far behind the first camera a browser begins, on the stage, so that it sees that camera."""


def free_port(host: str, port: int, option: str = "--port", of_host: str = "--host") -> int:
    """A port that can be listened on: the one asked for, or any free port for 0.

    Args:
        host: The address to listen on.
        port: The port.
        option: The option by which the user names the port.
        of_host: The option by which the user names the host, or a word for a host that is given.

    Raises:
        ParameterError: The port is taken or out of range, or the host is not this machine's.
    """
    if not 0 <= port <= MOST_PORT:
        raise ParameterError(
            f"{option} from 0 to {MOST_PORT}",
            found=f"{port}",
            fix="Pass another (0: any free one).",
        )
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            return int(probe.getsockname()[1])
    except OSError as error:
        raise ParameterError(
            f"to listen on {of_host} {host}, {option} {port}",
            found=error.strerror or str(error),
            fix=f"Pass another {option} (0: any free one); "
            f"{of_host} 127.0.0.1 is this machine alone.",
        ) from None


class Viewer:
    """Serves what was opened.

    Args:
        opened: What to show; the first defines the stage.
        host: The address to listen on.
        port: The port that ``free_port`` returned.
        device: Where to render; the CPU when left out.
        entries: The entries to show instead of one per item of ``opened``.
        most_points: The most points that a browser draws.
        beside: Which of the entries a browser begins with beside the first.

    Raises:
        MissingDependencyError: viser is absent.
    """

    def __init__(
        self,
        opened: list[Shown],
        host: str,
        port: int,
        device: torch.device | None = None,
        entries: list[Entry] | None = None,
        most_points: int = MOST_POINTS,
        beside: int | None = None,
    ) -> None:
        require("viser")
        import viser  # noqa: PLC0415  (of the extra view)

        self.frame = stage_frame(opened[0])
        self.entries = entries or [Entry(shown, self.frame, device) for shown in opened]
        self._most_points = most_points
        self._beside = None if beside is None else self.entries[beside]
        self._sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        # A browser may disconnect at any moment: no warning that it missed the rest.
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection")
        with redirect_stdout(io.StringIO()):  # viser prints its own address
            self.server: Any = viser.ViserServer(
                host=host, port=port, label="splatseed", verbose=False
            )
        self.server.gui.configure_theme(
            show_logo=False, show_share_button=False, control_width="large"
        )
        self._place_camera(opened[0])
        self.server.on_client_connect(self._welcome)
        self.server.on_client_disconnect(self._leave)

    def refresh(self) -> None:
        """Have every browser redraw."""
        for session in self.sessions:
            session.refresh()

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

    def greet(self, session: Session) -> None:
        """Called for each new browser; subclasses add controls here."""

    def _welcome(self, client: Any) -> None:
        session = Session(client, self.entries, self._most_points, self._beside)
        self.greet(session)
        with self._lock:
            self._sessions[client.client_id] = session

    def _leave(self, client: Any) -> None:
        with self._lock:
            session = self._sessions.pop(client.client_id, None)
        if session is not None:
            session.close()

    def _place_camera(self, shown: Shown) -> None:
        """Begin where the scene shows most, or outside the model."""
        scene = shown.scene
        if scene is not None and (scene.images or len(scene.points)):
            image = choose_image(scene) if len(scene.points) else scene.images[0]
            camera = choose_camera(scene) if image is None else image.camera
            up = -camera.cam_from_world[1, :3]
            if scene.images:
                up = -np.mean([i.camera.cam_from_world[1, :3] for i in scene.images], axis=0)
            fov = fitted_fov(camera, 1.5)
            _, position = stage_pose(camera, self.frame)
            ahead = camera.world_from_cam[:3, 2]
            if shown.gaussians is None:  # its cameras are shown too
                position = position - STEP_BACK * ahead
        else:
            assert shown.gaussians is not None  # noqa: S101  (nothing else is shown)
            (view,) = orbit([], shown.gaussians, 1, (600, 400))
            pose = view.cam_from_world
            up, ahead, fov = np.array([0.0, -1.0, 0.0]), pose[2, :3], 0.9
            position = (-pose[:3, :3].T @ pose[:3, 3] - self.frame.origin) * self.frame.scale
        self.server.scene.set_up_direction(tuple(up / np.linalg.norm(up)))
        start = self.server.initial_camera
        start.position, start.look_at = tuple(position), tuple(position + ahead)
        start.fov = fov


def stage_frame(shown: Shown) -> TrainingFrame:
    """The stage: the training frame or, without cameras, one fitted to the points or the model."""
    scene = shown.scene
    if shown.gaussians is not None:
        return model_frame(shown.gaussians, scene, shown.test_every)
    assert scene is not None  # noqa: S101  (there is a model or a scene)
    if len(scene.images) > 1:
        return _frame_of_cameras(scene, shown.test_every)
    xyz = scene.points.xyz[scene.points.finite].astype(np.float64)
    origin = np.median(xyz, axis=0) if len(xyz) else np.zeros(3)
    reach = float(np.quantile(np.linalg.norm(xyz - origin, axis=1), CORE)) if len(xyz) else 1.0
    return TrainingFrame(origin, 1 / reach if reach > 0 else 1.0)


def _frame_of_cameras(scene: Scene, test_every: int) -> TrainingFrame:
    return training_frame(poses_of(scene.split(test_every)[0]))
