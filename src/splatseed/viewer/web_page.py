"""A model as one web page: viser's viewer, with the Gaussians inside a single .html file.

Promise: the page needs no network and no server; a browser opens it from disk. It has what viser's
splats can hold: positions, covariances in half precision, and per Gaussian one opacity and one
colour of 8 bits each. Colours that depend on the view become their mean over the training cameras.
"""

from __future__ import annotations

import html
import io
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from scipy.spatial.transform import Rotation

from splatseed.errors import OutputError
from splatseed.findings import Finding
from splatseed.io.staging import atomic_file
from splatseed.photos.upright import up_direction
from splatseed.photos.view import View
from splatseed.photos.visibility import points_in_image
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.rendering.harmonics import sh_basis
from splatseed.requirements import require
from splatseed.sampling import evenly_spaced
from splatseed.splat.gaussians import SH_C0, Gaussians, antialiasing_finding
from splatseed.splat.packing import opacity_bytes, unit_quats
from splatseed.text import counted
from splatseed.viewer.flights import orbit
from splatseed.viewer.models import ViewerItem, viewer_frame
from splatseed.viewer.page import GROUND
from splatseed.viewer.server import place_camera

MAX_GAUSSIANS = 4_000_000
"""Most Gaussians in a page. Browsers load it as one text, of at most half a gigabyte in Chrome, and
unpack it to several times that."""
PAGE_BYTES = 35
"""Bytes of a page per Gaussian, about."""
COLOR_VIEWS = 24
"""Training cameras, evenly chosen, over which colours are averaged: with 100, PSNR is within 0.1 dB
on three captures."""
MAX_SIZE = 250.0
"""Largest standard deviation in the page's unit: half precision holds squares up to 65,504."""
MIN_SIZE = 0.03
"""Smallest for which half precision holds a covariance to 0.1%, except for very flat ones."""
SMALL_SHARE = 0.05
"""Share of the Gaussians that may be smaller than that, to keep the largest as they are."""
TINY = float(np.finfo(np.float32).tiny)
_WORKER = """<script>
// Chrome does not start module workers from blobs in a page from disk: the worker that sorts the
// Gaussians by depth is started as a classic one.
if (location.protocol === "file:") {
  const Module = Worker;
  window.Worker = class extends Module {
    constructor(url, options) {
      const request = new XMLHttpRequest();
      request.open("GET", url, false);
      request.send();
      const code = request.responseText.replaceAll("import.meta.url", "self.location.href");
      const blob = new Blob([code], { type: "text/javascript" });
      super(URL.createObjectURL(blob), { ...options, type: "classic" });
    }
  };
}
</script>"""


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
) -> None:
    """Write a model as a web page that starts at its first training camera.

    Without a scene it starts outside of the model.
    """
    require("viser")
    import viser  # noqa: PLC0415  (of the extra view)

    model = item.model
    check_page_size(len(model))
    progress("encode", 0.0)
    if model.antialiased:
        note(antialiasing_finding("a web page"))
    frame = viewer_frame(item)
    covariances, unit, clipped = page_covariances(model, frame.scale)
    if clipped:
        text = f"The page draws {counted(clipped, 'huge Gaussian')} smaller: it cannot hold them."
        note(Finding("clipped-sizes", text))
    colors = mean_colors(model, item.central_views)
    means = (model.means.astype(np.float64) - frame.origin) * frame.scale
    progress("encode", 0.5)
    with redirect_stdout(io.StringIO()):  # viser prints an address
        server: Any = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        ground = np.full((1, 1, 3), GROUND, np.uint8)
        server.scene.set_background_image(ground, format="png")
        server.scene.add_gaussian_splats(
            "/gaussians",
            (unit * means).astype(np.float32),
            covariances,
            colors,
            opacity_bytes(model.opacities)[:, None],
            scale=1 / unit,
        )
        views = item.central_views
        start = views[0] if views else orbit([], model, 1, (600, 400))[0]
        place_camera(server, start.camera, up_direction([view.camera for view in views]), frame)
        farthest = np.linalg.norm(means, axis=1).max() + MAX_SIZE / unit
        server.initial_camera.far = float(max(server.initial_camera.far, 2 * farthest))
        text = server.get_scene_serializer().as_html()
    finally:
        with redirect_stdout(io.StringIO()):
            server.stop()
    text = text.replace("<title>Viser</title>", f"<title>{html.escape(item.name)}</title>", 1)
    text = text.replace("<script", f"{_WORKER}<script", 1)
    progress("encode", 1.0)
    with atomic_file(path) as partial:
        partial.write_text(text, "utf-8")


def page_covariances(
    model: Gaussians, scale: float
) -> tuple[Float32[np.ndarray, "N 3 3"], float, int]:
    """Return covariances for half precision, their unit per viewer frame unit, and a count.

    The unit makes the largest fit, unless that would round many small ones off; then the count of
    Gaussians that are clipped is not 0.
    """
    sizes = np.exp(model.scales.astype(np.float64)) * scale
    largest = sizes.max(axis=1)
    small, huge = (max(float(np.quantile(largest, q)), TINY) for q in (SMALL_SHARE, 1.0))
    unit = max(MAX_SIZE / huge, MIN_SIZE / small)
    clipped = int(np.count_nonzero(largest * unit > MAX_SIZE * (1 + 1e-9)))
    # Rotation times the size along each of its axes: RS, and RS (RS)' is the covariance.
    rotated = Rotation.from_quat(unit_quats(model.quats)[:, [1, 2, 3, 0]]).as_matrix()
    rotated = rotated * np.minimum(sizes * unit, MAX_SIZE)[:, None, :]
    return (rotated @ rotated.transpose(0, 2, 1)).astype(np.float32), unit, clipped


def mean_colors(model: Gaussians, views: tuple[View, ...]) -> UInt8[np.ndarray, "N 3"]:
    """Return sRGB colours: the mean over training cameras that have a Gaussian in their image.

    Cameras count by the inverse square of the distance, as a Gaussian's share of the image does.
    Gaussians in no image keep the mean over all directions.
    """
    base = 0.5 + SH_C0 * model.sh0[:, 0].astype(np.float64)
    total, weights = np.zeros((len(model), 3)), np.zeros(len(model))
    chosen = evenly_spaced(len(views), COLOR_VIEWS) if model.shN.size else ()
    for camera in (views[i].camera for i in chosen):
        seen = points_in_image(camera, model.means).point_idx
        rays: Float64[np.ndarray, "M 3"] = model.means[seen] - camera.center
        distance = np.linalg.norm(rays, axis=1)
        basis = sh_basis(rays / distance[:, None], 1 + model.shN.shape[1])[:, 1:]
        color = base[seen] + np.einsum("mk,mkc->mc", basis, model.shN[seen])
        total[seen] += np.clip(color, 0, 1) / distance[:, None] ** 2
        weights[seen] += 1 / distance**2
    known = weights > 0
    base[known] = total[known] / weights[known, None]
    return np.rint(255 * np.clip(base, 0, 1)).astype(np.uint8)
