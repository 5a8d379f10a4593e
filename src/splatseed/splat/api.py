"""``ss.render``. Needs PyTorch (``pip install ".[train]"``)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from splatseed.errors import ParameterError
from splatseed.requirements import require

require("torch")  # before the imports below, for one clear error

from splatseed.camera import Camera
from splatseed.photos.view import View, view_of
from splatseed.runtime.torch_device import DeviceName, load_kernels, pick_torch_device
from splatseed.scene import Image
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import frame_of_model


def render(
    gaussians: Gaussians, camera: Image | Camera | View, *, backend: DeviceName = "auto"
) -> Float32[np.ndarray, "H W 3"]:
    """Render Gaussians from a camera.

    The near plane is a hundredth of the depth beyond which nine tenths of the Gaussians in the
    image lie. ``Run.render`` is faster for many images of a run, as it keeps the Gaussians on the
    device.

    Args:
        gaussians: The Gaussians, in the camera's world frame.
        camera: An image of a scene (``scene["DSC07956.JPG"]``), without its lens distortion; a
            ``Camera``; or a view.
        backend: "cpu", "cuda", or "auto" (a GPU if PyTorch finds one, else the CPU).

    Returns:
        sRGB colours in [0, 1], float32, in the camera's size, on a black background.

    Raises:
        ParameterError: An argument has another type, or ``backend`` is "cuda" without a GPU.
        MissingDependencyError: PyTorch is absent, or gsplat's kernels cannot be built.

    Example:
        splat = ss.read_gaussians("point_cloud.ply")
        picture = ss.render(splat, scene["DSC07956.JPG"])
    """
    if not isinstance(gaussians, Gaussians):
        raise ParameterError(
            "`gaussians` as Gaussians",
            found=type(gaussians).__name__,
            fix="Pass what read_gaussians returns, or the `gaussians` of a run.",
        )
    device = pick_torch_device(backend, "backend")
    if device.type == "cuda":
        load_kernels("backend")
    view = view_of(camera)
    frame = frame_of_model([view], np.empty((0, 3), np.float32), gaussians)
    return ModelRenderer(gaussians, frame, device).color(view)
