"""A model as one web page: PlayCanvas's SuperSplat viewer, with the model inside as an ``.sog``.

Promise: the page needs no network and no server; a browser opens it from disk. It draws what the
``.sog`` keeps: sizes, opacities and colours that depend on the view, as sharp as training saw them
(``_as_trained``). The folder ``supersplat`` has the stylesheet and the bundle of
@playcanvas/supersplat-viewer 1.36.2 as published, compressed by ``gzip -9n``, and its licence.
Source of its options and settings: its API reference.

Notation: the page's frame is the viewer frame, turned so that up is -y: the viewer turns a file's
axes by half a turn about z, and takes y for up.
"""

from __future__ import annotations

import gzip
import html
import json
import math
import tempfile
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from string import Template

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.errors import OutputError
from splatseed.io.staging import atomic_file
from splatseed.photos.upright import vertical
from splatseed.photos.view import View
from splatseed.photos.viewpoint import choose_image
from splatseed.photos.visibility import points_in_image
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.sampling import evenly_spaced
from splatseed.similarity import Similarity
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import transform_gaussians
from splatseed.viewer.flights import DEFAULT_SIZE, orbit, orbit_center
from splatseed.viewer.models import ViewerItem, viewer_frame

MAX_GAUSSIANS = 4_000_000
"""Most Gaussians in a page: browsers unpack a model to several times its size."""
PAGE_BYTES = 40
"""Bytes of a page per Gaussian, about."""
ASPECT = 1.5
"""Of the window that shows the whole first image."""
MAX_FOV = 120.0
"""Of the viewer's cameras, degrees."""
BLUR = 0.3
"""Variance that rendering adds to each Gaussian, pixels squared."""
KERNEL = 1.076
"""Area under a Gaussian, cut off where alpha is 1/255, over that under the viewer's kernel, which
subtracts exp(-4) so as to vanish at sqrt(8) sigma; of an opaque Gaussian."""
BLUR_VIEWS = 24
"""Training cameras, evenly chosen, whose pixels give the blur of training."""
_HALF_TURN = np.diag([-1.0, -1.0, 1.0])
_PAGE = Template("""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>$name</title>
<!-- SuperSplat viewer: $licence -->
<style>$style
html, body { height: 100%; margin: 0; overflow: hidden; background: rgb($background); }</style>
</head>
<body>
<script type="text/plain" id="code">$viewer</script>
<script type="text/plain" id="model">$model</script>
<script type="module">
const bytes = (id) =>
  Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
const fail = (error) => {
  document.body.textContent = `This browser cannot show the model: $${error}`;
};
window.show = (createViewer) => {
  const contents = Promise.resolve(new Response(bytes("model")));
  createViewer({ container: document.body, contents, ...$options }).then((viewer) => {
    viewer.events.on("loaded:changed", () => (viewer.state.cameraMode = "orbit"));
    window.viewer = viewer;
  }).catch(fail);
};
try {
  const code = new Blob([bytes("code")]).stream().pipeThrough(new DecompressionStream("gzip"));
  const script = document.createElement("script");
  script.type = "module";
  script.textContent = (await new Response(code).text()) + "\\nwindow.show(createViewer);";
  document.head.append(script);
} catch (error) {
  fail(error);
}
</script>
</body>
</html>
""")


def check_page_size(gaussians: int) -> None:
    """Raise ``OutputError`` if a page of so many Gaussians would be too large for browsers."""
    if gaussians > MAX_GAUSSIANS:
        raise OutputError(
            f"at most {MAX_GAUSSIANS:,} Gaussians in a web page, "
            f"{MAX_GAUSSIANS * PAGE_BYTES / 1e6:,.0f} MB, as browsers load",
            found=f"{gaussians:,}, {gaussians * PAGE_BYTES / 1e6:,.0f} MB",
            fix="Leave out faint ones (`min_opacity`) or keep a part (`crop`), or write an .spz "
            "for a viewer that reads it.",
        )


def write_page(
    path: Path, item: ViewerItem, progress: Progress = silent, note: Note = silent_note
) -> Gaussians:
    """Write a model as a web page that starts at the training camera that sees most.

    Without a scene it starts outside of the model.

    Returns:
        The Gaussians as the page has them, for renders with the blur of training, in the item's
        world.
    """
    model, start, center = item.model, *_start(item)
    check_page_size(len(model))
    placed = _page_from_world(item, start)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.sog"
        shown = _as_trained(model, item.train_views)
        write_gaussians(file, transform_gaussians(shown, placed), progress, note)
        packed, held = file.read_bytes(), read_gaussians(file)
    ahead = start.world_from_cam[:3, 2]
    distance = max(float((center - start.center) @ ahead), 1e-2 / placed.scale)
    places = placed.points(np.stack([start.center, start.center + distance * ahead])) @ _HALF_TURN
    camera = {"position": places[0].tolist(), "target": places[1].tolist(), "fov": _fov(start)}
    color = [value / 255 for value in item.background]
    options = {
        # Version 1, which the viewer reads with all effects off.
        "settings": {"background": {"color": color}, "camera": camera},
        "contentUrl": "model.sog",
        "contentFilename": "model.sog",
        "noanim": True,
        "renderer": "webgpu",  # or WebGL, where a browser has none
        "aa": model.antialiased,
        "exposeGlobals": True,
    }
    supersplat = files("splatseed.viewer") / "supersplat"
    text = _PAGE.substitute(
        name=html.escape(item.name),
        licence=(supersplat / "LICENSE").read_text("utf-8"),
        style=gzip.decompress((supersplat / "index.css.gz").read_bytes()).decode(),
        background=", ".join(map(str, item.background)),
        viewer=b64encode((supersplat / "index.js.gz").read_bytes()).decode(),
        model=b64encode(packed).decode(),
        options=json.dumps(options),
    )
    with atomic_file(path) as partial:
        partial.write_text(text, "utf-8")
    return _as_trained(transform_gaussians(held, placed.inverse), item.train_views, undo=True)


def _as_trained(model: Gaussians, views: Sequence[View], *, undo: bool = False) -> Gaussians:
    """Enlarge Gaussians so that the viewer shows them as training did, or undo that.

    Rendering blurs by ``BLUR`` in pixels of the photographs; the viewer by less, in pixels of the
    window: thin Gaussians become spikes between which one sees the background. So the blur becomes
    part of their size, that of the training cameras that have them in their image: the mean over
    these, by the inverse square of the distance. The viewer's narrower kernel is made up for.
    """
    xyz, seen = np.asfortranarray(model.means, np.float64), np.zeros(len(model))
    chosen = () if model.antialiased else evenly_spaced(len(views), BLUR_VIEWS)
    weights = np.zeros(len(model))
    for camera in (views[i].camera for i in chosen):
        inside = points_in_image(camera, xyz)
        seen[inside.point_idx] += 1
        weights[inside.point_idx] += camera.K[0, 0] * camera.K[1, 1] / inside.depth**2
    blur = np.divide(BLUR * seen, weights, out=np.zeros(len(model)), where=seen > 0)[:, None]
    squares = np.exp(2 * model.scales.astype(np.float64))
    if undo:
        squares = np.maximum(squares / KERNEL - blur, 1e-6 * squares)
    else:
        squares = KERNEL * (squares + blur)
    return replace(model, scales=(np.log(squares) / 2).astype(np.float32))


def _start(item: ViewerItem) -> tuple[Camera, Float64[np.ndarray, " 3"]]:
    """Return the camera at which a page starts, and the point that it can be turned around."""
    views, scene = item.central_views, item.scene
    if not views or scene is None:
        view = orbit([], item.model, 1, DEFAULT_SIZE)[0]
        return view.camera, np.median(item.model.means.astype(np.float64), axis=0)
    chosen = choose_image(scene.replace(images=tuple(scene[view.name] for view in views)))
    start = next(view for view in views if chosen is None or view.name == chosen.name)
    return start.camera, orbit_center(views, item.model)


def _page_from_world(item: ViewerItem, start: Camera) -> Similarity:
    """Return the transform to the page's frame, in which the first camera looks along z."""
    frame = viewer_frame(item)
    up = vertical(item.scene, [view.camera for view in item.central_views])
    # The camera's x axis is the better guide where it looks up or down.
    forward = np.cross(start.world_from_cam[:3, 0], -up)
    forward /= np.linalg.norm(forward)
    rotation = np.stack([np.cross(-up, forward), -up, forward])
    return Similarity(frame.scale, rotation, -frame.scale * rotation @ frame.origin)


def _fov(camera: Camera) -> float:
    """Return the field of view over the longer side, degrees, that contains a camera's image."""
    width, height = camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]
    return min(math.degrees(2 * math.atan(max(width, ASPECT * height) / 2)), MAX_FOV)
