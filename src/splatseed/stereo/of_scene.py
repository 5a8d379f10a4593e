"""``stereo_depths``: stereo between all photographs of a scene."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from splatseed.errors import SceneNotFoundError
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.stereo.maps import StereoMap
from splatseed.stereo.settings import StereoSettings


def stereo_depths(
    scene: Scene,
    settings: StereoSettings | None = None,
    *,
    seed: int = 0,
    progress: Progress = silent,
    **choices: Any,
) -> tuple[StereoMap, ...]:
    """Depth, normals and confidence of every photograph of a scene.

    Args:
        scene: A scene with photographs.
        settings: The choices of stereo; the defaults when left out.
        seed: The same seed gives the same bytes.
        progress: Called with the stage and the fraction done.
        choices: Fields of the settings, such as ``grid=2``.

    Raises:
        ParameterError: A choice is out of range.
        SceneNotFoundError: There are fewer than two photographs.
        SceneFormatError: A photograph cannot be used.
    """
    from splatseed.stereo.depths import find_stereo  # noqa: PLC0415  (kernels load with use)
    from splatseed.stereo.without_points import known_visibility  # noqa: PLC0415  (loads with its use)
    from splatseed.views.view import data_factor, load_views  # noqa: PLC0415  (loads with its use)

    settings = replace(settings or StereoSettings(), **choices)
    if len(scene.images) < 2:
        raise SceneNotFoundError(
            "at least two photographs with a pose",
            found=f"{len(scene.images)}",
            fix="Name a scene with photographs: depth comes from comparing them.",
        )
    views = load_views(
        scene,
        scene.images,
        data_factor=data_factor(scene.images, settings.max_size),
        undistort=True,
        progress=progress,
    )
    stereo = find_stereo(views, scene.images, known_visibility(scene), settings, seed, progress)
    return tuple(stereo.map(i) for i in range(len(stereo.views)))
