"""One connected browser: its controls, its camera, and the pictures sent to it.

Promise: two browsers share nothing but what is shown; when a browser disconnects, its thread ends.
"""

from __future__ import annotations

import io
import logging
import threading
import time
from typing import Any

import numpy as np

from splatseed.errors import SplatseedError
from splatseed.literal import visible
from splatseed.preview.photographs import photograph_at
from splatseed.scene import Image, Scene
from splatseed.viewer.canvas import canvas_view, fitted_fov, stage_pose
from splatseed.viewer.frames import split_picture
from splatseed.viewer.live import FrameLoop
from splatseed.viewer.pictures import NOTHING, Drawn, Entry
from splatseed.viewer.stage import add_cameras, add_clouds, clouds_of, point_size
from splatseed.views.view import View

MOST_PIXELS = 1_600_000
"""The most pixels of a full picture; on larger canvases it is stretched."""
THUMBNAIL = 96
MOST_POINTS = 5_000_000
"""The most points sent to a browser, if it is quick enough; larger clouds are thinned evenly."""
FIRST_POINTS, ENOUGH_MORE = 300_000, 1.5
"""Points sent at once, and how many times as many are worth sending again."""
PATIENCE, MOST_PATIENCE = 0.3, 30.0
"""Seconds that the points of a picture may take (without a GPU a million take some seconds), and
the longest wait for an answer."""
FLIGHT_SECONDS, FLIGHT_STEPS = 0.5, 15
_LOG = logging.getLogger(__name__)
ARRIVED = 1e-3
NO_SECOND = "nothing"
CLEAR_OF_CONTROLS = 0.38
"""Where the border between two pictures begins: the controls cover the right of the window."""
JPEG_MOVING, JPEG_STILL = 70, 92


class Session:
    """A browser's view of the entries.

    Args:
        client: viser's handle of the browser.
        entries: What was opened; at least one.
        most_points: The most points that the browser draws.
        beside: The entry whose model is shown beside that of the first, from the beginning.
    """

    def __init__(
        self,
        client: Any,
        entries: list[Entry],
        most_points: int = MOST_POINTS,
        beside: Entry | None = None,
    ) -> None:
        self._most_points = most_points
        self._beside = beside
        self._client = client
        self._entries = {entry.name: entry for entry in entries}
        self._goal: Image | None = None
        self._picture: np.ndarray | None = None
        self._nodes: dict[str, Any] = {}
        self._cameras: list[tuple[Image, Any]] = []
        self._closed = False
        self._loop = FrameLoop(self._draw)
        self._build()
        client.camera.on_update(lambda _: self._loop.change())
        self._loop.change()
        self._fill_stage()

    def close(self) -> None:
        """The browser has disconnected."""
        self._closed = True
        self._loop.close()

    @property
    def gui(self) -> Any:
        """The browser's controls, for callers that add their own."""
        return self._client.gui

    def refresh(self) -> None:
        """What is shown has changed."""
        self._loop.change()

    # Controls -----------------------------------------------------------------------------------

    def _build(self) -> None:
        gui, names = self._client.gui, list(self._entries)
        first = self._entries[names[0]]
        self._what = gui.add_dropdown("Show", names, visible=len(names) > 1)
        kinds = self._kinds(first)
        self._kind = gui.add_dropdown(
            "Picture", kinds, initial_value=kinds[1 if first.has_model else 0]
        )
        seconds = self._second_choices()
        second = self._second_at_first()
        self._second = gui.add_dropdown("Beside it", seconds, initial_value=second)
        border = 0.5 if second == NO_SECOND else CLEAR_OF_CONTROLS
        shown = second != NO_SECOND
        self._split = gui.add_slider("Border at", 0.05, 0.95, 0.01, border, visible=shown)
        self._note = gui.add_markdown("", visible=False)
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
        for each in (self._kind, self._second, self._split):
            each.on_update(lambda _: self._changed())
        for each in (self._points_on, self._by_origin, self._size, self._cameras_on):
            each.on_update(lambda _: self._restyle())
        self._what.on_update(lambda _: self._switched())
        self._go.on_update(lambda _: self._go_to(self._go.value))
        shot.on_click(lambda _: self._screenshot())

    @staticmethod
    def _kinds(entry: Entry) -> tuple[str, ...]:
        return (NOTHING, *entry.kinds)

    def _second_choices(self) -> tuple[str, ...]:
        """Every picture of every entry, prefixed with the entry's name if there are several."""
        several = len(self._entries) > 1
        pairs = [(entry, kind) for entry in self._entries.values() for kind in entry.kinds]
        self._seconds = {
            f"{entry.name}: {kind}" if several else kind: (entry, kind) for entry, kind in pairs
        }
        return (NO_SECOND, *self._seconds)

    def _second_at_first(self) -> str:
        """The picture of the entry that was asked for beside the first."""
        if self._beside is None or not self._beside.has_model:
            return NO_SECOND
        pictures = (self._beside, self._beside.kinds[0])
        return next(name for name, pair in self._seconds.items() if pair == pictures)

    @property
    def _entry(self) -> Entry:
        return self._entries[self._what.value]

    def _switched(self) -> None:
        """Another entry was chosen: replace pictures, points and cameras by its own."""
        kinds = self._kinds(self._entry)
        self._kind.options = kinds
        if self._kind.value not in kinds:
            self._kind.value = kinds[-1] if not self._entry.has_model else kinds[1]
        self._goal = None
        self._fill_stage()
        self._loop.change()

    def _changed(self) -> None:
        self._split.visible = self._second.value != NO_SECOND
        self._loop.change()

    # The stage ----------------------------------------------------------------------------------

    def _fill_stage(self) -> None:
        scene, frame = self._entry.shown.scene, self._entry.frame
        for handle in (*self._nodes.values(), *(h for _, h in self._cameras)):
            handle.remove()
        for box in self._origins.values():
            box.remove()
        self._nodes, self._cameras, self._origins = {}, [], {}
        if scene is None:
            return
        if scene.images:
            every = self._entry.shown.test_every
            self._cameras = add_cameras(self._client.scene, scene, frame, self._fly, every)
            self._go.options = ("-", *(image.name for image, _ in self._cameras))
        self._send_points(scene, min(self._most_points, FIRST_POINTS))
        with self._origin_folder:
            for name in self._nodes:
                self._origins[name] = self._client.gui.add_checkbox(name, initial_value=True)
                self._origins[name].on_update(lambda _: self._restyle())
        self._restyle()
        threading.Thread(target=self._fill_in, daemon=True).start()

    def _send_points(self, scene: Scene, most: int) -> None:
        """Send the browser at most ``most`` points, in place of those it has."""
        clouds = clouds_of(scene.points, self._entry.frame, most)
        if clouds:
            self._clouds = {cloud.name: cloud for cloud in clouds}
            self._base_size = point_size(clouds, scene.images, self._entry.frame)
            self._nodes = add_clouds(self._client.scene, clouds, self._base_size)

    def _fill_in(self) -> None:
        """Send what can wait: photographs, and as many more points as the browser draws quickly."""
        self._add_thumbnails()
        scene, nodes = self._entry.shown.scene, self._nodes
        if scene is None or min(self._most_points, len(scene.points)) <= FIRST_POINTS:
            return
        try:
            wanted = min(self._most_points, self._affordable_points())
        except Exception:  # noqa: BLE001  (the browser went away, or hides its page)
            return
        if wanted > ENOUGH_MORE * FIRST_POINTS and nodes is self._nodes and not self._closed:
            self._send_points(scene, wanted)
            self._restyle()

    def _affordable_points(self) -> int:
        """How many points the browser can draw in reasonable time, measured on its first points."""
        try:
            without, with_points = (self._seconds_of_a_picture(points=on) for on in (False, True))
        finally:  # it may not have answered
            self._restyle()
        return round(FIRST_POINTS * PATIENCE / max(with_points - without, 1e-3))

    def _seconds_of_a_picture(self, *, points: bool) -> float:
        """How long the browser takes to draw a small picture and to send it."""
        for node in self._nodes.values():
            node.visible = points
        seconds = 0.0
        for _ in range(2):  # the first may still show the points as they were
            start = time.perf_counter()
            self._client.get_render(48, 64, transport_format="jpeg", timeout=MOST_PATIENCE)
            seconds = time.perf_counter() - start
        return seconds

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
        self._show_cameras()
        self._legend.content = self._legend_html() if self._nodes else ""

    def _show_cameras(self) -> None:
        """Hide the camera at which the browser stands: its photograph would block the view."""
        on, at = self._cameras_on.value, self.at
        for image, handle in self._cameras:
            if handle.visible != (wanted := on and image is not at):
                handle.visible = wanted

    def _legend_html(self) -> str:
        rows = []
        for name in self._nodes:
            cloud = self._clouds[name]
            rgb = ",".join(map(str, cloud.color))
            dot = f'<span style="color:rgb({rgb});font-size:1.4em">&#9679;</span>'
            shown = "" if len(cloud.xyz) == cloud.count else f" ({len(cloud.xyz):,} shown)"
            rows.append(f"<div>{dot} {name}: {cloud.count:,}{shown}</div>")
        return f'<div id="legend" style="padding:0 1em">{"".join(rows)}</div>'

    def _add_thumbnails(self) -> None:
        scene, cameras = self._entry.shown.scene, list(self._cameras)
        for image, handle in cameras:
            if self._closed or scene is None or cameras != self._cameras:
                return
            camera = image.camera
            scale = THUMBNAIL / max(camera.width, camera.height)
            size = (max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))
            thumbnail = photograph_at(scene, image, size)
            if thumbnail is not None:
                handle.image = thumbnail

    # The camera ---------------------------------------------------------------------------------

    def _go_to(self, name: str) -> None:
        image = next((image for image, _ in self._cameras if image.name == name), None)
        if image is not None:
            self._fly(image)

    def _fly(self, image: Image) -> None:
        """Move to where an image was taken, in half a second."""
        camera = self._client.camera
        wxyz, position = stage_pose(image.camera, self._entry.frame)
        start, origin = np.array(camera.wxyz), np.array(camera.position)
        # q and -q are one rotation: the nearer one gives the shorter turn.
        wxyz = wxyz * (1 if wxyz @ start >= 0 else -1)
        fov, first = fitted_fov(image.camera, camera.aspect), camera.fov
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
        self._loop.change()

    @property
    def at(self) -> Image | None:
        """The image whose camera the browser flew to and still stands at, or None."""
        if self._goal is None:
            return None
        camera = self._client.camera
        wxyz, position = stage_pose(self._goal.camera, self._entry.frame)
        apart = np.abs(np.asarray(camera.position) - position).max()
        there = apart < ARRIVED and abs(wxyz @ np.asarray(camera.wxyz)) > 1 - ARRIVED**2
        return self._goal if there else None

    # Pictures -----------------------------------------------------------------------------------

    def _draw(self, scale: float) -> int:
        """Draw what is asked for and send it; returns the number of pixels drawn."""
        try:
            return self._drawn(scale)
        except SplatseedError as error:
            self._say(str(error))
        except Exception as error:  # noqa: BLE001  (the thread must live on)
            if self._closed:  # the browser has disconnected meanwhile
                return 0
            _LOG.exception("a picture could not be drawn")
            self._say(f"{type(error).__name__}: {error}")
        return 0

    def _drawn(self, scale: float) -> int:
        kind, second = self._kind.value, self._seconds.get(self._second.value)
        self._show_cameras()
        if kind == NOTHING and second is None:
            self._show(None, 0)
            self._say("")
            return 0
        canvas = self._canvas(scale)
        at = self.at
        drawn: list[Drawn] = [(None, "")]
        if kind != NOTHING:
            drawn = [self._entry.draw(kind, canvas, at, quick=scale < 1)]
        if second is not None:
            drawn.append(second[0].draw(second[1], canvas, at, quick=scale < 1))
        self._say(" ".join(dict.fromkeys(why for _, why in drawn if why)))
        picture = self._joined(drawn, canvas, named=scale == 1)
        self._show(picture, JPEG_STILL if scale == 1 else JPEG_MOVING)
        return canvas.width * canvas.height

    def _canvas(self, scale: float) -> View:
        camera = self._client.camera
        width, height = camera.image_width, camera.image_height
        scale *= min(1.0, np.sqrt(MOST_PIXELS / (width * height)))
        size = (max(8, round(scale * width)), max(8, round(scale * height)))
        return canvas_view(camera.wxyz, camera.position, camera.fov, size, self._entry.frame)

    def _joined(self, drawn: list[Drawn], canvas: View, *, named: bool) -> np.ndarray | None:
        white = np.full((canvas.height, canvas.width, 3), 255, np.uint8)
        pictures = [white if picture is None else picture for picture, _ in drawn]
        if len(pictures) == 1:
            return drawn[0][0]
        names = (self._kind.value, self._second.value)
        if len(self._entries) > 1:
            names = (f"{self._entry.name}: {names[0]}", names[1])
        names = names if named else ("", "")  # letters would be huge in a coarse picture
        return split_picture(pictures[0], pictures[1], *names, at=float(self._split.value))

    def _show(self, picture: np.ndarray | None, quality: int) -> None:
        self._picture = picture
        scene = self._client.scene
        scene.set_background_image(picture, format="jpeg", jpeg_quality=quality or None)
        self._client.flush()

    def _say(self, text: str) -> None:
        shown = visible(text)
        if self._note.content != shown:
            self._note.content, self._note.visible = shown, bool(shown)

    def _screenshot(self) -> None:
        """Send what the browser shows, points over picture, as a PNG to save."""
        from PIL import Image as PillowImage  # noqa: PLC0415  (slow to import)

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
