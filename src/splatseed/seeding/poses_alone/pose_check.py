"""Whether photographs agree at their poses: a second's look, before minutes of comparing.

Notation: poses are ``cam_from_world`` [V, 4, 4]. A *look* compares a photograph and its best
partners, ``SIDE`` pixels wide, over every depth; its *share* is that of the pixels whose depth
others confirm. A *turn* undoes a usual mistake in writing poses. Promise: the scene's scale plays
no part; a scene is refused only if its photographs agree by chance at most, or clearly better after
a turn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.literal import quoted
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.seeding.poses_alone.pose_error import pose_error
from splatseed.stereo.matching import match_views
from splatseed.stereo.settings import StereoSettings
from splatseed.stereo.without_points import any_depth
from splatseed.views.pairs import choose_by_pose
from splatseed.views.view import View, data_factor, load_views, poses_of

Poses = Float64[np.ndarray, "V 4 4"]

SIDE, GRID, SWEEPS = 200, 4, 6
"""Size of the photographs, pixels between depths, and iterations of a look."""
TOLERANCE, MAX_COST = 0.03, 0.4
PARTNERS = 5
LOOKS = 3
"""Photographs looked at, while what is seen decides nothing."""
ENOUGH = 0.3
"""Share at which nothing else is tried; wrong poses reached 0.17."""
CLEARLY = 2.0
"""A share so many times another is clearly above it."""
LEAST = 0.1
"""Least share after a turn at which the turn is believed."""
NIL = 0.03
"""Share that photographs of eleven captures reached by chance, with their poses exchanged; with
their own, the hardest reached 0.07."""
MOST_SEEN = 24
"""Photographs whose pictures are searched for any overlap."""

_YZ, _XY = np.diag([1.0, -1.0, -1.0, 1.0]), np.diag([-1.0, -1.0, 1.0, 1.0])
TURNS: Mapping[str, Callable[[Poses], Poses]] = MappingProxyType(
    {
        "the y and z axes of every camera are negated": lambda poses: _YZ @ poses,
        "the x and y axes of every camera are negated": lambda poses: _XY @ poses,
        "every pose is inverted": np.linalg.inv,
        "every pose is inverted and its camera's y and z axes are negated": (
            lambda poses: _YZ @ np.linalg.inv(poses)
        ),
    }
)
OPENCV = "with OpenCV's camera axes (x right, y down, z forward)"
WRITTEN = {
    "colmap": f"the model's images hold cam_from_world, {OPENCV}",
    "rgbd": f"its trajectory holds world_from_cam, {OPENCV}",
    "transforms": "each transform_matrix is world_from_cam, with OpenGL's camera axes (x right, "
    "y up, z back)",
}
"""What each format's poses are."""


def check_poses(scene: Scene, images: Sequence[Image], progress: Progress = silent) -> float:
    """Refuse photographs that cannot be compared at their poses, within seconds.

    Args:
        scene: A scene with photographs, whose points are not used.
        images: The images whose photographs are to be compared.
        progress: Called with the stage and the fraction done.

    Returns:
        The largest share of pixels whose depth other photographs confirm, of those looked at.

    Raises:
        SceneNotFoundError: There are fewer than two.
        SceneFormatError: All cameras are in one place, no two photographs show the same, they agree
            nowhere, or clearly better if poses are read otherwise; or one cannot be used.
    """
    poses = np.array([image.camera.cam_from_world for image in images])
    _check_places(poses)
    shares: list[float] = []
    for number in range(LOOKS):
        progress("check poses", number / LOOKS)
        shares.append(_look(scene, images, poses, number))
        if shares[-1] >= ENOUGH:
            break
        turned = {how: _look(scene, images, turn(poses), number) for how, turn in TURNS.items()}
        best = max(turned, key=lambda how: turned[how])
        if turned[best] >= max(CLEARLY * shares[-1], LEAST):
            raise _turned_error(scene, shares[-1], best, turned[best])
        if shares[-1] > max(CLEARLY * turned[best], NIL):
            break
    else:
        if np.mean(shares) <= NIL:
            raise _apart_error(scene, images, float(np.mean(shares)))
    progress("check poses", 1.0)
    return max(shares)


def _check_places(poses: Poses) -> None:
    """Refuse cameras that are alone, or all in one place."""
    if len(poses) < 2:
        raise SceneNotFoundError(
            "at least two photographs with a pose, as the scene has no points",
            found=f"{len(poses)}",
            fix="Add photographs: depth comes from comparing them. Views held out do not count.",
        )
    centers = np.linalg.inv(poses)[:, :3, 3]
    apart = np.abs(centers - centers[0]).max()
    if apart <= np.finfo(np.float32).eps * np.abs(centers).max():
        raise SceneFormatError(
            "photographs from different places, as the scene has no points",
            found=f"all {len(poses)} cameras in one place, as in a panorama",
            fix="Take photographs while moving: cameras that only turn show no depth.",
        )


def _look(scene: Scene, images: Sequence[Image], poses: Poses, number: int) -> float:
    """The share of a photograph and its partners at these poses."""
    first = (2 * number + 1) * len(images) // (2 * LOOKS)
    partners = choose_by_pose(poses, PARTNERS)[first]
    chosen = [first, *partners[partners >= 0].tolist()]
    some = [images[i] for i in chosen]
    read = load_views(scene, some, data_factor=data_factor(some, SIDE), undistort=True)
    views = [replace(view, cam_from_world=poses[i]) for view, i in zip(read, chosen, strict=True)]
    sources = choose_by_pose(poses[chosen], PARTNERS)
    settings = StereoSettings(grid=GRID, sweeps=SWEEPS, tolerance=TOLERANCE, max_cost=MAX_COST)
    hints = [any_depth(views, i, others) for i, others in enumerate(sources)]
    stereo = match_views(views, hints, sources, settings, 0, silent)
    return float(np.mean([stereo.kept(i).mean() for i in range(len(views))]))


def _camera(view: View) -> Camera:
    return Camera(view.K, view.width, view.height, view.cam_from_world)


def _turned_error(scene: Scene, share: float, how: str, after: float) -> SceneFormatError:
    assert scene.source is not None  # noqa: S101  (its photographs were read)
    return SceneFormatError(
        f"photographs that agree at the poses of {scene.source.root}",
        found=f"a depth that others confirm at {share:.1%} of their pixels, and at {after:.0%} once"
        f" {how}",
        fix=f"Write the poses so: {WRITTEN[scene.source.format]}.",
    )


def _apart_error(scene: Scene, images: Sequence[Image], share: float) -> SceneFormatError:
    """The error for photographs that agree nowhere, and why they may not."""
    assert scene.source is not None  # noqa: S101  (its photographs were read)
    new = f"splatseed sfm {quoted(scene.source.image_dir or 'IMAGES')} -o SCENE"
    if not _any_overlap(poses_of(images)):
        return SceneFormatError(
            f"photographs that show the same places, at the poses of {scene.source.root}",
            found=f"no two of {len(images)} whose pictures overlap at any depth",
            fix=f"Take more photographs in between, or find the poses anew: {new}.",
        )
    error = pose_error(scene, images)
    if error is not None and not error.exact:
        return SceneFormatError(
            f"photographs that agree at the poses of {scene.source.root}",
            found=f"a depth that others confirm at {share:.1%} of their pixels; they miss each "
            f"other by about {error}",
            fix=f"Mend the poses with --refine-poses, or find them anew: {new}.",
        )
    return SceneFormatError(
        f"photographs that agree at the poses of {scene.source.root}",
        found=f"a depth that others confirm at {share:.1%} of their pixels",
        fix=f"Check that poses and names of the images belong together, or find poses anew: {new}.",
    )


def _any_overlap(views: Sequence[View]) -> bool:
    """Whether a point at some depth before one view falls into another's picture."""
    uv = (np.indices((4, 5)).reshape(2, -1).T[:, ::-1] + 0.5) / [5, 4]
    looked = np.unique(np.linspace(0, len(views) - 1, MOST_SEEN).round().astype(np.int64))
    for i in looked:
        for j in range(len(views)):
            first, other = _camera(views[i]), _camera(views[j])
            gap = float(np.linalg.norm(first.center - other.center))
            if i == j or not gap:
                continue
            z = gap * np.repeat(np.geomspace(0.1, 1000.0, 12), len(uv))
            xyz = first.unproject(np.tile(uv * [first.width, first.height], (12, 1)), z)
            seen = other.project(xyz)[0]  # NaN behind the camera
            if ((seen >= 0) & (seen < [other.width, other.height])).all(axis=1).any():
                return True
    return False
