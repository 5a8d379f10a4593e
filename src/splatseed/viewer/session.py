"""A connected browser: its controls, its camera, and the pictures sent to it.

Notation: a *frame* is a picture sent; its scale is its size relative to the canvas. Promise: the
newest camera is drawn, never a queue of old ones, coarsely while it moves and at full size when it
is still; browsers share the entries only; when a browser disconnects, only its own thread ends.
"""

from __future__ import annotations

import html
import io
import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image as PillowImage

from splatseed.io.seeds import method_of_points
from splatseed.photos.view import View
from splatseed.scene import Image, Scene
from splatseed.text import visible
from splatseed.viewer import pictures
from splatseed.viewer.models import split_picture
from splatseed.viewer.page import GROUND, fitted, photograph_at
from splatseed.viewer.pictures import Entry

NO_PICTURE, NO_SECOND = "points only", "nothing"
THUMBNAIL = 96  # longer side in pixels
CLOSE_SECONDS = 2.0  # to wait for the frame being drawn
BORDER = 0.38
"""Initial border between two pictures: the controls cover the right of the window."""


@dataclass(frozen=True)
class _Frames:
    moving_seconds: float = 0.12  # that a frame may take while the camera moves
    still_after: float = 0.2  # seconds without movement until the full picture
    min_scale: float = 0.12
    first_scale: float = 0.3  # before any frame has been timed
    smoothing: float = 0.5  # weight of the latest frame in the estimated cost per pixel
    max_pixels: int = 1_600_000  # of a full picture; on larger canvases it is stretched
    jpeg_moving: int = 70
    jpeg_still: int = 92


@dataclass(frozen=True)
class _Points:
    first: int = 300_000  # sent at once
    limit: int = 5_000_000  # for a fast browser
    min_factor: float = 1.5  # of more points that are worth sending again
    seconds: float = 0.3  # that a browser may take to draw them; a million take seconds on a CPU
    timeout: float = 30.0  # of a browser's answer


@dataclass(frozen=True)
class _Flight:
    seconds: float = 0.5
    steps: int = 15
    tolerance: float = 1e-3  # in the viewer frame, at which a camera counts as being there


FRAMES, POINTS, FLIGHT = _Frames(), _Points(), _Flight()
_LOG = logging.getLogger(__name__)


class FrameLoop:
    """Thread that calls ``draw(scale)``, which returns the pixels drawn, after each ``change``."""

    def __init__(self, draw: Callable[[float], int]) -> None:
        self._draw = draw
        self._changed, self._closed = threading.Event(), False
        self._pixel_seconds: float | None = None
        self._full_pixels = 1.0
        self.frames = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def change(self) -> None:
        """Request a frame: the camera or the content has changed."""
        self._changed.set()

    def close(self) -> None:
        """End the loop after the current frame."""
        self._closed = True
        self._changed.set()
        self._thread.join(CLOSE_SECONDS)

    def _run(self) -> None:
        while True:
            self._changed.wait()
            if self._closed:
                return
            self._changed.clear()
            scale = FRAMES.first_scale
            if self._pixel_seconds is not None:  # the largest within the time of a frame
                affordable = FRAMES.moving_seconds / self._pixel_seconds / self._full_pixels
                scale = float(np.clip(np.sqrt(affordable), FRAMES.min_scale, 1.0))
            start = time.perf_counter()
            pixels = self._frame(scale)
            if pixels:  # full frames are not timed: they draw Gaussians that coarse frames skip
                cost = (time.perf_counter() - start) / pixels
                before = cost if self._pixel_seconds is None else self._pixel_seconds
                weight = FRAMES.smoothing
                self._pixel_seconds = weight * cost + (1 - weight) * before
            if scale < 1 and not self._changed.wait(FRAMES.still_after):
                self._frame(1.0)

    def _frame(self, scale: float) -> int:
        pixels = self._draw(scale)
        if pixels:
            self.frames += 1
            self._full_pixels = pixels / scale**2
        return pixels


class Session:
    """State of a browser; ``client`` is viser's handle of it.

    At first the model of ``second``, if given, is shown to the right of the first entry's.
    """

    def __init__(self, client: Any, entries: list[Entry], second: Entry | None = None) -> None:
        self._second_entry, self._client = second, client
        self._entries = {entry.name: entry for entry in entries}
        self._target: Image | None = None
        self._picture: np.ndarray | None = None
        self._nodes: dict[str, Any] = {}
        self._cameras: list[tuple[Image, Any]] = []
        self._closed = False
        self._loop = FrameLoop(self._draw)
        self._build()
        client.camera.on_update(lambda _: self.refresh())
        self.refresh()
        self._fill_scene()

    def close(self) -> None:
        """End the session of a disconnected browser."""
        self._closed = True
        self._loop.close()

    def refresh(self) -> None:
        """Request a new picture."""
        self._loop.change()

    # Controls -----------------------------------------------------------------------------------

    def _build(self) -> None:
        gui, names = self._client.gui, list(self._entries)
        first = self._entries[names[0]]
        self._what = gui.add_dropdown("Show", names, visible=len(names) > 1)
        kinds = (NO_PICTURE, *first.kinds)
        kind = kinds[1 if first.has_model else 0]
        self._kind = gui.add_dropdown("Picture", kinds, initial_value=kind)
        self._seconds = {
            f"{entry.name}: {kind}" if len(names) > 1 else kind: (entry, kind)
            for entry in self._entries.values()
            for kind in entry.kinds
        }
        second = NO_SECOND
        if self._second_entry is not None and self._second_entry.has_model:
            second = f"{self._second_entry.name}: {self._second_entry.kinds[0]}"
        seconds, split = (NO_SECOND, *self._seconds), second != NO_SECOND
        self._second = gui.add_dropdown("Second picture", seconds, initial_value=second)
        border = BORDER if split else 0.5
        self._split = gui.add_slider("Border at", 0.05, 0.95, 0.01, border, visible=split)
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
        """Show the pictures, points and cameras of another entry."""
        kinds = (NO_PICTURE, *self._entry.kinds)
        self._kind.options = kinds
        if self._kind.value not in kinds:
            self._kind.value = kinds[-1] if not self._entry.has_model else kinds[1]
        self._target = None
        self._fill_scene()
        self.refresh()

    def _changed(self) -> None:
        self._split.visible = self._second.value != NO_SECOND
        self.refresh()

    # Points and cameras -------------------------------------------------------------------------

    def _fill_scene(self) -> None:
        item, frame = self._entry.item, self._entry.frame
        cameras = (handle for _, handle in self._cameras)
        for handle in (*self._nodes.values(), *cameras, *self._origins.values()):
            handle.remove()
        self._nodes, self._cameras, self._origins = {}, [], {}
        self._go.options, self._legend.content = ("-",), ""
        if item.scene is None:
            return
        if item.scene.images:
            self._cameras = pictures.add_cameras(self._client.scene, item, frame, self._fly)
            self._go.options = ("-", *(image.name for image, _ in self._cameras))
        self._send_points(item.scene, POINTS.first)
        with self._origin_folder:
            for name in self._nodes:
                self._origins[name] = self._client.gui.add_checkbox(name, initial_value=True)
                self._origins[name].on_update(lambda _: self._restyle())
        self._restyle()
        threading.Thread(target=self._send_rest, daemon=True).start()

    def _send_points(self, scene: Scene, limit: int) -> None:
        """Replace the browser's points by at most ``limit`` points of the scene."""
        other = method_of_points(scene)
        clouds = pictures.clouds_by_origin(scene.points, self._entry.frame, limit, other)
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

    def _send_rest(self) -> None:
        """Send photographs, and as many more points as the browser draws fast."""
        scene, nodes, cameras = self._entry.item.scene, self._nodes, self._cameras
        for image, handle in cameras:
            if self._closed or scene is None or cameras is not self._cameras:
                return
            size = fitted(image.camera.width, image.camera.height, THUMBNAIL)
            thumbnail = photograph_at(image, size)
            if thumbnail is not None:
                handle.image = thumbnail
        if scene is None or len(scene.points) <= POINTS.first:
            return
        try:
            affordable = min(POINTS.limit, self._affordable_points())
        except Exception:  # noqa: BLE001  (the browser disconnected, or hides its page)
            return
        more = affordable > POINTS.min_factor * POINTS.first
        if more and nodes is self._nodes and not self._closed:
            self._send_points(scene, affordable)
            self._restyle()

    def _affordable_points(self) -> int:
        """Estimate how many points the browser can draw in time, from its first points."""
        seconds = {}
        try:
            for shown in (False, True):
                for node in self._nodes.values():
                    node.visible = shown
                for _ in range(2):  # the first may still draw the previous points
                    start = time.perf_counter()
                    self._client.get_render(48, 64, transport_format="jpeg", timeout=POINTS.timeout)
                    seconds[shown] = time.perf_counter() - start
        finally:  # also after a timeout
            self._restyle()
        return round(POINTS.first * POINTS.seconds / max(seconds[True] - seconds[False], 1e-3))

    def _restyle(self) -> None:
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
        """Show the cameras except the camera that the browser is at, which would block the view."""
        on, at = self._cameras_on.value, self.at
        for image, handle in self._cameras:
            if handle.visible != (visible_now := on and image is not at):
                handle.visible = visible_now

    # The camera ---------------------------------------------------------------------------------

    def _go_to(self) -> None:
        for image, _ in self._cameras:
            if image.name == self._go.value:
                self._fly(image)

    def _fly(self, image: Image) -> None:
        camera = self._client.camera
        wxyz, position = pictures.viewer_pose(image.camera, self._entry.frame)
        start, origin = np.array(camera.wxyz), np.array(camera.position)
        # q and -q are one rotation: the nearer one gives the shorter turn.
        wxyz = wxyz * (1 if wxyz @ start >= 0 else -1)
        fov, first = pictures.fitted_fov(image.camera, camera.aspect), camera.fov
        self._target = image
        for step in range(1, FLIGHT.steps + 1):
            part = step / FLIGHT.steps
            # Smoothstep: speed 0 at both ends.
            ease = part * part * (3 - 2 * part)
            turn = (1 - ease) * start + ease * wxyz
            with self._client.atomic():
                camera.wxyz = turn / np.linalg.norm(turn)
                camera.position = (1 - ease) * origin + ease * position
                camera.fov = (1 - ease) * first + ease * fov
            time.sleep(FLIGHT.seconds / FLIGHT.steps)
        self.refresh()

    @property
    def at(self) -> Image | None:
        """The image whose camera the browser flew to and is still at, or None."""
        if self._target is None:
            return None
        camera = self._client.camera
        wxyz, position = pictures.viewer_pose(self._target.camera, self._entry.frame)
        distance = np.abs(np.asarray(camera.position) - position).max()
        cosine = abs(wxyz @ np.asarray(camera.wxyz))
        there = distance < FLIGHT.tolerance and cosine > 1 - FLIGHT.tolerance**2
        return self._target if there else None

    # Pictures -----------------------------------------------------------------------------------

    def _draw(self, scale: float) -> int:
        """Draw the selected pictures and send them; returns the number of pixels drawn."""
        try:
            return self._draw_selected(scale)
        except Exception as error:  # noqa: BLE001  (the thread must go on)
            if not self._closed:
                _LOG.exception("a picture could not be drawn")
                self._show_note(f"{type(error).__name__}: {error}")
        return 0

    def _draw_selected(self, scale: float) -> int:
        kind, second = self._kind.value, self._seconds.get(self._second.value)
        self._show_cameras()
        selected = [(self._entry, kind)] if kind != NO_PICTURE else []
        selected += [second] if second is not None else []
        canvas, at = self._canvas(scale), self.at
        drawn = [entry.draw(kind, canvas, at, fast=scale < 1) for entry, kind in selected]
        self._show_note(" ".join(dict.fromkeys(why for _, why in drawn if why)))
        picture = drawn[0][0] if drawn else None
        if second is not None:
            picture = self._join([(None, ""), *drawn][-2:], canvas, named=scale == 1)
        self._picture, quality = picture, FRAMES.jpeg_still if scale == 1 else FRAMES.jpeg_moving
        ground = np.full((canvas.height, canvas.width, 3), GROUND, np.uint8)
        shown = ground if picture is None else picture  # behind points that the browser draws
        self._client.scene.set_background_image(shown, format="jpeg", jpeg_quality=quality)
        self._client.flush()
        return canvas.width * canvas.height if drawn else 0

    def _canvas(self, scale: float) -> View:
        camera = self._client.camera
        width, height = camera.image_width, camera.image_height
        scale *= min(1.0, np.sqrt(FRAMES.max_pixels / (width * height)))
        size = max(8, round(scale * width)), max(8, round(scale * height))
        return pictures.canvas_view(
            camera.wxyz, camera.position, camera.fov, size, self._entry.frame
        )

    def _join(self, drawn: list[pictures.Drawn], canvas: View, *, named: bool) -> np.ndarray:
        ground = np.full((canvas.height, canvas.width, 3), GROUND, np.uint8)
        left, right = (ground if picture is None else picture for picture, _ in drawn)
        names = (self._kind.value, self._second.value)
        if len(self._entries) > 1:
            names = (f"{self._entry.name}: {names[0]}", names[1])
        names = names if named else ("", "")  # in a coarse picture the font would be huge
        return split_picture(left, right, *names, at=float(self._split.value))

    def _show_note(self, text: str) -> None:
        # Escaped: a photograph's name could contain a script.
        content = f'<div style="padding:0 1em">{html.escape(visible(text))}</div>' if text else ""
        if self._note.content != content:
            self._note.content, self._note.visible = content, bool(content)

    def _screenshot(self) -> None:
        """Send the browser's view, points over picture, as a PNG to save."""
        camera = self._client.camera
        size = (camera.image_width, camera.image_height)
        over = PillowImage.fromarray(
            self._client.get_render(size[1], size[0], transport_format="png", timeout=20.0)
        ).convert("RGBA")
        under = PillowImage.new("RGBA", over.size, GROUND)
        if self._picture is not None:
            under.paste(PillowImage.fromarray(self._picture).resize(over.size))
        file = io.BytesIO()
        PillowImage.alpha_composite(under, over).convert("RGB").save(file, "PNG")
        self._client.send_file_download("splatseed.png", file.getvalue(), save_immediately=True)
