"""One connected browser: its controls, its camera, and the pictures sent to it.

Notation: a *frame* is one picture sent; the scale of a frame is its size divided by the canvas's.
Promise: the newest camera is drawn, never a queue of old ones, coarsely while it moves and in full
when it is still; two browsers share nothing but what is shown; when a browser disconnects, only its
own thread ends.
"""

from __future__ import annotations

import html
import io
import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image as PillowImage

from splatseed.photos.view import View
from splatseed.scene import Image, Scene
from splatseed.text import visible
from splatseed.viewer import pictures
from splatseed.viewer.models import split_picture
from splatseed.viewer.page import fitted, photograph_at
from splatseed.viewer.pictures import Entry

MOVING_SECONDS, STILL_AFTER = 0.12, 0.2
"""Seconds a frame may take while the camera moves, and without movement until the full picture."""
LEAST_SCALE, FIRST_SCALE = 0.12, 0.3
"""Coarsest scale of a frame, and the scale before any frame has been timed."""
CLOSE_SECONDS = 2.0  # to wait for the frame being drawn
MEMORY = 0.5
"""Weight of the latest frame in the running estimate of the cost per pixel."""
MOST_PIXELS = 1_600_000  # of a full picture; on larger canvases it is stretched
THUMBNAIL = 96
FIRST_POINTS, ENOUGH_MORE, MOST_POINTS = 300_000, 1.5, 5_000_000
"""Points sent at once, how many times as many are worth sending again, and the most that a quick
browser gets; larger clouds are thinned evenly."""
PATIENCE, MOST_PATIENCE = 0.3, 30.0
"""Seconds that the points of a picture may take (without a GPU a million take some seconds), and
the longest wait for an answer."""
FLIGHT_SECONDS, FLIGHT_STEPS = 0.5, 15
ARRIVED = 1e-3
NOTHING, NO_SECOND = "points only", "nothing"
CLEAR_OF_CONTROLS = 0.38
"""Where the border between two pictures begins: the controls cover the right of the window."""
JPEG_MOVING, JPEG_STILL = 70, 92
_LOG = logging.getLogger(__name__)


class FrameLoop:
    """Draws a frame after each call of ``change``: ``draw`` returns its pixels, 0 for none."""

    def __init__(self, draw: Callable[[float], int]) -> None:
        self._draw = draw
        self._changed, self._closed = threading.Event(), False
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
            scale = FIRST_SCALE
            if self._pixel_seconds is not None:  # at which a frame just meets its time
                affordable = MOVING_SECONDS / self._pixel_seconds / self._full_pixels
                scale = float(np.clip(np.sqrt(affordable), LEAST_SCALE, 1.0))
            began = time.perf_counter()
            pixels = self._frame(scale)
            if pixels:  # a full frame teaches nothing: it draws Gaussians that a coarse one skips
                took = (time.perf_counter() - began) / pixels
                before = took if self._pixel_seconds is None else self._pixel_seconds
                self._pixel_seconds = MEMORY * took + (1 - MEMORY) * before
            if scale < 1 and not self._changed.wait(STILL_AFTER):
                self._frame(1.0)

    def _frame(self, scale: float) -> int:
        pixels = self._draw(scale)
        if pixels:
            self.frames += 1
            self._full_pixels = pixels / scale**2
        return pixels


class Session:
    """A browser's view of what was opened; viser's ``client`` is its handle.

    The model of ``beside`` is shown beside that of the first entry, from the beginning.
    """

    def __init__(self, client: Any, entries: list[Entry], beside: Entry | None = None) -> None:
        self._beside, self._client = beside, client
        self._entries = {entry.name: entry for entry in entries}
        self._goal: Image | None = None
        self._picture: np.ndarray | None = None
        self._nodes: dict[str, Any] = {}
        self._cameras: list[tuple[Image, Any]] = []
        self._closed = False
        self._loop = FrameLoop(self._draw)
        self._build()
        client.camera.on_update(lambda _: self.refresh())
        self.refresh()
        self._fill_stage()

    def close(self) -> None:
        """The browser has disconnected."""
        self._closed = True
        self._loop.close()

    def refresh(self) -> None:
        """The camera moved, or what is shown has changed."""
        self._loop.change()

    # Controls -----------------------------------------------------------------------------------

    def _build(self) -> None:
        gui, names = self._client.gui, list(self._entries)
        first = self._entries[names[0]]
        self._what = gui.add_dropdown("Show", names, visible=len(names) > 1)
        kinds = (NOTHING, *first.kinds)
        kind = kinds[1 if first.has_model else 0]
        self._kind = gui.add_dropdown("Picture", kinds, initial_value=kind)
        self._seconds = {
            f"{entry.name}: {kind}" if len(names) > 1 else kind: (entry, kind)
            for entry in self._entries.values()
            for kind in entry.kinds
        }
        second = NO_SECOND
        if self._beside is not None and self._beside.has_model:
            second = f"{self._beside.name}: {self._beside.kinds[0]}"
        seconds, shown = (NO_SECOND, *self._seconds), second != NO_SECOND
        self._second = gui.add_dropdown("Beside it", seconds, initial_value=second)
        border = CLEAR_OF_CONTROLS if shown else 0.5
        self._split = gui.add_slider("Border at", 0.05, 0.95, 0.01, border, visible=shown)
        self._note = gui.add_html("", visible=False)
        shot = gui.add_button("Screenshot")
        with gui.add_folder("Points"):
            self._points_on = gui.add_checkbox("Show points", not first.has_model)
            self._by_origin = gui.add_checkbox("By origin", initial_value=False)
            self._size = gui.add_slider("Size", 0.2, 5.0, 0.1, 1.0)
            self._legend = gui.add_html("")
            self._origins: dict[str, Any] = {}
            self._origin_folder = gui.add_folder("Origins", expand_by_default=False)
        with gui.add_folder("Cameras"):
            self._cameras_on = gui.add_checkbox("Show cameras", not first.has_model)
            self._go = gui.add_dropdown("Fly to", ("-",))
        for boxes, changed in (
            ((self._kind, self._second, self._split), self._changed),
            ((self._points_on, self._by_origin, self._size, self._cameras_on), self._restyle),
            ((self._what,), self._switched),
            ((self._go,), self._go_to),
        ):
            for box in boxes:
                box.on_update(lambda _, changed=changed: changed())
        shot.on_click(lambda _: self._screenshot())

    @property
    def _entry(self) -> Entry:
        return self._entries[self._what.value]

    def _switched(self) -> None:
        """Another entry was chosen: its pictures, points and cameras come."""
        kinds = (NOTHING, *self._entry.kinds)
        self._kind.options = kinds
        if self._kind.value not in kinds:
            self._kind.value = kinds[-1] if not self._entry.has_model else kinds[1]
        self._goal = None
        self._fill_stage()
        self.refresh()

    def _changed(self) -> None:
        self._split.visible = self._second.value != NO_SECOND
        self.refresh()

    # The stage ----------------------------------------------------------------------------------

    def _fill_stage(self) -> None:
        shown, frame = self._entry.shown, self._entry.frame
        cameras = (handle for _, handle in self._cameras)
        for handle in (*self._nodes.values(), *cameras, *self._origins.values()):
            handle.remove()
        self._nodes, self._cameras, self._origins = {}, [], {}
        self._go.options, self._legend.content = ("-",), ""
        if shown.scene is None:
            return
        if shown.scene.images:
            self._cameras = pictures.add_cameras(self._client.scene, shown, frame, self._fly)
            self._go.options = ("-", *(image.name for image, _ in self._cameras))
        self._send_points(shown.scene, FIRST_POINTS)
        with self._origin_folder:
            for name in self._nodes:
                self._origins[name] = self._client.gui.add_checkbox(name, initial_value=True)
                self._origins[name].on_update(lambda _: self._restyle())
        self._restyle()
        threading.Thread(target=self._fill_in, daemon=True).start()

    def _send_points(self, scene: Scene, most: int) -> None:
        """Send the browser at most ``most`` points, in place of those it has."""
        clouds = pictures.clouds_of(scene.points, self._entry.frame, most)
        if clouds:
            self._clouds = {cloud.name: cloud for cloud in clouds}
            self._base_size = pictures.point_size(clouds, scene.images, self._entry.frame)
            self._nodes = {
                cloud.name: self._client.scene.add_point_cloud(
                    f"/points/{cloud.name}",
                    cloud.xyz,
                    cloud.rgb,
                    point_size=self._base_size,
                    point_shape="circle",
                    point_shading="flat",
                    precision="float32",
                )
                for cloud in clouds
            }

    def _fill_in(self) -> None:
        """Send what can wait: photographs, and as many more points as the browser draws quickly."""
        scene, nodes, cameras = self._entry.shown.scene, self._nodes, self._cameras
        for image, handle in cameras:
            if self._closed or scene is None or cameras is not self._cameras:
                return
            size = fitted(image.camera.width, image.camera.height, THUMBNAIL)
            thumbnail = photograph_at(scene, image, size)
            if thumbnail is not None:
                handle.image = thumbnail
        if scene is None or len(scene.points) <= FIRST_POINTS:
            return
        try:
            wanted = min(MOST_POINTS, self._affordable_points())
        except Exception:  # noqa: BLE001  (the browser went away, or hides its page)
            return
        if wanted > ENOUGH_MORE * FIRST_POINTS and nodes is self._nodes and not self._closed:
            self._send_points(scene, wanted)
            self._restyle()

    def _affordable_points(self) -> int:
        """How many points the browser draws in reasonable time, measured on its first points."""
        seconds = {}
        try:
            for shown in (False, True):
                for node in self._nodes.values():
                    node.visible = shown
                for _ in range(2):  # the first may still show the points as they were
                    start = time.perf_counter()
                    self._client.get_render(48, 64, transport_format="jpeg", timeout=MOST_PATIENCE)
                    seconds[shown] = time.perf_counter() - start
        finally:  # it may not have answered
            self._restyle()
        return round(FIRST_POINTS * PATIENCE / max(seconds[True] - seconds[False], 1e-3))

    def _restyle(self) -> None:
        """Style points and cameras as the switches say."""
        for name, node in self._nodes.items():
            node.visible = self._points_on.value and self._origins[name].value
            node.point_size = self._base_size * self._size.value
            cloud = self._clouds[name]
            colors = cloud.rgb
            if self._by_origin.value:
                colors = np.broadcast_to(np.array(cloud.color, np.uint8), cloud.rgb.shape)
            if not np.array_equal(node.colors[:1], colors[:1]) or self._by_origin.value:
                node.colors = colors
        rows = []
        for cloud in (self._clouds[name] for name in self._nodes):
            dot = f'<span style="color:rgb{cloud.color};font-size:1.4em">&#9679;</span>'
            shown = "" if len(cloud.xyz) == cloud.count else f" ({len(cloud.xyz):,} shown)"
            rows.append(f"<div>{dot} {cloud.name}: {cloud.count:,}{shown}</div>")
        self._legend.content = f'<div id="legend" style="padding:0 1em">{"".join(rows)}</div>'
        self._show_cameras()

    def _show_cameras(self) -> None:
        """Hide the camera at which the browser stands: its photograph would block the view."""
        on, at = self._cameras_on.value, self.at
        for image, handle in self._cameras:
            if handle.visible != (wanted := on and image is not at):
                handle.visible = wanted

    # The camera ---------------------------------------------------------------------------------

    def _go_to(self) -> None:
        for image, _ in self._cameras:
            if image.name == self._go.value:
                self._fly(image)

    def _fly(self, image: Image) -> None:
        """Move to where an image was taken, in half a second."""
        camera = self._client.camera
        wxyz, position = pictures.stage_pose(image.camera, self._entry.frame)
        start, origin = np.array(camera.wxyz), np.array(camera.position)
        # q and -q are one rotation: the nearer one gives the shorter turn.
        wxyz = wxyz * (1 if wxyz @ start >= 0 else -1)
        fov, first = pictures.fitted_fov(image.camera, camera.aspect), camera.fov
        self._goal = image
        for step in range(1, FLIGHT_STEPS + 1):
            part = step / FLIGHT_STEPS
            # Smoothstep: starts and ends gently.
            ease = part * part * (3 - 2 * part)
            turn = (1 - ease) * start + ease * wxyz
            with self._client.atomic():
                camera.wxyz = turn / np.linalg.norm(turn)
                camera.position = (1 - ease) * origin + ease * position
                camera.fov = (1 - ease) * first + ease * fov
            time.sleep(FLIGHT_SECONDS / FLIGHT_STEPS)
        self.refresh()

    @property
    def at(self) -> Image | None:
        """The image whose camera the browser flew to and still stands at, or None."""
        if self._goal is None:
            return None
        camera = self._client.camera
        wxyz, position = pictures.stage_pose(self._goal.camera, self._entry.frame)
        apart = np.abs(np.asarray(camera.position) - position).max()
        there = apart < ARRIVED and abs(wxyz @ np.asarray(camera.wxyz)) > 1 - ARRIVED**2
        return self._goal if there else None

    # Pictures -----------------------------------------------------------------------------------

    def _draw(self, scale: float) -> int:
        """Draw what is asked for and send it; returns the number of pixels drawn."""
        try:
            return self._drawn(scale)
        except Exception as error:  # noqa: BLE001  (the thread must live on)
            if not self._closed:  # the browser is still there
                _LOG.exception("a picture could not be drawn")
                self._say(f"{type(error).__name__}: {error}")
        return 0

    def _drawn(self, scale: float) -> int:
        kind, second = self._kind.value, self._seconds.get(self._second.value)
        self._show_cameras()
        asked = [(self._entry, kind)] if kind != NOTHING else []
        asked += [second] if second is not None else []
        canvas, at = self._canvas(scale), self.at
        drawn = [entry.draw(kind, canvas, at, quick=scale < 1) for entry, kind in asked]
        self._say(" ".join(dict.fromkeys(why for _, why in drawn if why)))
        picture = drawn[0][0] if drawn else None
        if second is not None:
            picture = self._joined([(None, ""), *drawn][-2:], canvas, named=scale == 1)
        self._picture, quality = picture, JPEG_STILL if scale == 1 else JPEG_MOVING
        self._client.scene.set_background_image(picture, format="jpeg", jpeg_quality=quality)
        self._client.flush()
        return canvas.width * canvas.height if drawn else 0

    def _canvas(self, scale: float) -> View:
        camera = self._client.camera
        width, height = camera.image_width, camera.image_height
        scale *= min(1.0, np.sqrt(MOST_PIXELS / (width * height)))
        size, frame = (
            tuple(max(8, round(scale * side)) for side in (width, height)),
            self._entry.frame,
        )
        return pictures.canvas_view(camera.wxyz, camera.position, camera.fov, size, frame)

    def _joined(self, drawn: list[pictures.Drawn], canvas: View, *, named: bool) -> np.ndarray:
        white = np.full((canvas.height, canvas.width, 3), 255, np.uint8)
        left, right = (white if picture is None else picture for picture, _ in drawn)
        names = (self._kind.value, self._second.value)
        if len(self._entries) > 1:
            names = (f"{self._entry.name}: {names[0]}", names[1])
        names = names if named else ("", "")  # letters would be huge in a coarse picture
        return split_picture(left, right, *names, at=float(self._split.value))

    def _say(self, text: str) -> None:
        # As text: names of photographs may be anything, and the page would run a script.
        shown = f'<div style="padding:0 1em">{html.escape(visible(text))}</div>' if text else ""
        if self._note.content != shown:
            self._note.content, self._note.visible = shown, bool(shown)

    def _screenshot(self) -> None:
        """Send what the browser shows, points over picture, as a PNG to save."""
        camera = self._client.camera
        size = (camera.image_width, camera.image_height)
        over = PillowImage.fromarray(
            self._client.get_render(size[1], size[0], transport_format="png", timeout=20.0)
        ).convert("RGBA")
        under = PillowImage.new("RGBA", over.size, "white")
        if self._picture is not None:
            under.paste(PillowImage.fromarray(self._picture).resize(over.size))
        file = io.BytesIO()
        PillowImage.alpha_composite(under, over).convert("RGB").save(file, "PNG")
        self._client.send_file_download("splatseed.png", file.getvalue(), save_immediately=True)
