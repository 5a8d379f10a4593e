"""Items that the viewer shows (scenes, runs, files of Gaussians) and the viewer's frame.

Notation: the *viewer frame* is the world moved and scaled so that near planes and single precision
suffice: the training frame if the scene is known, else a frame fitted to the item. Promise: a
file's content determines its kind; a model has the scene that its run or the user names.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image as PillowImage, ImageDraw

from splatseed.camera import Camera
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io import load_scene
from splatseed.io.exclusion import EXCLUDED, exclude
from splatseed.io.files import StrPath
from splatseed.photos.camera_check import reference_points
from splatseed.photos.upright import quarter_turns, turned
from splatseed.photos.view import View, camera_views, view_of
from splatseed.progress import Note
from splatseed.scene import BLACK, TEST_EVERY, Color, Scene
from splatseed.similarity import Similarity
from splatseed.splat.background import background_of
from splatseed.splat.formats import holds_gaussians, read_gaussians, unpacked_model
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import move_to_scene_origin, scene_from_model, transform_gaussians
from splatseed.splat.training_frame import TrainingFrame, frame_of_model
from splatseed.text import quoted
from splatseed.training.config import has_run_poses, without_dropped
from splatseed.training.folder import RunFolder
from splatseed.viewer.page import font, latin

CORE = 0.6
"""Fraction of the points, nearest to their median, that the frame is fitted to without cameras."""
LINE = 2  # pixels of the border between two pictures


@dataclass(frozen=True, eq=False)
class ViewerItem:
    """A scene, a model, or a model with its scene, in the scene's world.

    Args:
        name: Its label.
        scene: The scene.
        gaussians: The model.
        data_factor: By which the model's run downsampled photographs.
        test_every: Every n-th image by name is a test view; 0: none.
        findings: What was changed in the model on reading.
        moved: How the model was moved from its trainer's frame; None if it was in the scene's.
        background: Of its renders, over which transparent pixels of photographs are composited.
    """

    name: str
    scene: Scene | None = None
    gaussians: Gaussians | None = None
    data_factor: float = 1
    test_every: int = TEST_EVERY
    findings: tuple[Finding, ...] = ()
    moved: Similarity | None = None
    background: Color = BLACK

    @property
    def model(self) -> Gaussians:
        """The Gaussians of an item that has some."""
        assert self.gaussians is not None  # noqa: S101  (callers check)
        return self.gaussians

    @property
    def train_views(self) -> tuple[View, ...]:
        """Training cameras, in pixels of the run's photographs; none without a scene."""
        images = self.scene.split(self.test_every)[0] if self.scene else ()
        return camera_views(images, self.data_factor)

    @property
    def central_views(self) -> tuple[View, ...]:
        """Training cameras without strays far from all others, upright."""
        views, strays = self.train_views, viewer_frame(self).strays
        central = [view for view in views if view.name not in strays]
        turns = quarter_turns([self.scene[view.name] for view in central] if self.scene else ())
        pairs = zip(central, turns, strict=True)
        return tuple(replace(view, camera=turned(view.camera, turn)) for view, turn in pairs)


def open_item(
    path: StrPath, scene_path: Path | None = None, excluded: Sequence[str] = ()
) -> ViewerItem:
    """Read a scene, a run folder, or a file of Gaussians or points.

    A model's scene is at ``scene_path``, by default where its run's config has it, if it exists.
    Photographs that ``excluded`` names, as for ``exclude``, are left out of it.
    """
    item = _read_item(Path(path), scene_path)
    if item.scene is None:
        if excluded:
            found = f"{path}, whose scene is not known"
            raise ParameterError("`exclude` with a scene", found=found, fix="Name its `scene`.")
        return item
    scene = exclude(item.scene, excluded)
    findings = (each for each in scene.findings if each.kind == EXCLUDED)
    return replace(item, scene=scene, findings=(*item.findings, *findings))


def _read_item(path: Path, scene_path: Path | None) -> ViewerItem:
    def scene_at(folder: Path | None) -> Scene | None:
        return None if folder is None else load_scene(folder, require_points=False)

    folder, findings = RunFolder(path), list[Finding]()
    if not path.is_dir() or not folder.is_run:
        path = unpacked_model(path) or path
        if path.is_file() and holds_gaussians(path):
            gaussians, scene = read_gaussians(path, findings.append), scene_at(scene_path)
            moved, background = None, background_of(path, note=findings.append) or BLACK
            if scene is not None:
                scene = scene.replace(background=background)
                gaussians, moved = _in_scene(path, scene, gaussians, findings.append)
            return ViewerItem(
                path.name, scene, gaussians,
                findings=tuple(findings), moved=moved, background=background,
            )  # fmt: skip
        scene = load_scene(path, require_points=False)
        if not scene.images and not len(scene.points):
            raise SceneFormatError(
                f"something to show at {path}",
                found="no images, points or Gaussians",
                fix="Name a scene, a run, or a file of points or Gaussians.",
            )
        return ViewerItem(path.name, scene, test_every=scene.default_test_every)
    if not folder.gaussians.is_file():
        raise SceneNotFoundError(
            f"{folder.path} to be a finished run of splatseed train",
            found="a run that has not finished",
            fix=f"Continue it: splatseed train SCENE -o {quoted(folder.path)} --resume.",
        )
    config, scene = folder.read_config(), scene_at(scene_path)
    scene = scene_of_run(folder) if scene is None else without_dropped(scene, config)
    factor, every = config.get("data_factor") or 1, int(config.get("test_every", TEST_EVERY))
    gaussians, moved = read_gaussians(folder.gaussians, findings.append), None
    if scene is not None:
        own = has_run_poses(config, scene)
        gaussians, moved = _in_scene(folder.gaussians, scene, gaussians, findings.append, own=own)
    return ViewerItem(folder.path.name, scene, gaussians, factor, every, tuple(findings), moved)


def _in_scene(
    path: Path, scene: Scene, gaussians: Gaussians, note: Note, *, own: bool = False
) -> tuple[Gaussians, Similarity | None]:
    """Move Gaussians to the frame of a scene; note it if they fit in none that is known.

    ``own``: they were trained at its poses. Also returns how they were moved there from their
    trainer's frame.
    """
    gaussians = move_to_scene_origin(path, scene, gaussians, note)
    if own:
        return gaussians, None
    try:
        moved = scene_from_model(path, scene, gaussians, note)
    except SceneFormatError as error:
        note(
            Finding(
                "another-scene",
                f"The cameras probably do not show the Gaussians of {path} as photographed. "
                f"Expected {error.expected}; found {error.found}.",
                subjects=(str(path),),
            )
        )
        return gaussians, None
    return gaussians if moved is None else transform_gaussians(gaussians, moved), moved


def scene_of_run(folder: RunFolder) -> Scene | None:
    """Read the scene that a run's config names; None if it cannot be read."""
    config = folder.read_config()
    own = folder.scene_of(config)
    if own is not None:
        with suppress(SceneNotFoundError, SceneFormatError):  # it was moved or deleted
            return without_dropped(load_scene(Path(own), require_points=False), config)
    return None


def unique_names(paths: Sequence[Path]) -> list[str]:
    """Shortest unique suffix of each path."""
    absolute = [path.absolute().parts for path in paths]
    names = []
    for parts in absolute:
        suffixes = (parts[start:] for start in reversed(range(len(parts))))
        unique = (s for s in suffixes if sum(other[-len(s) :] == s for other in absolute) == 1)
        names.append("/".join(next(unique, parts[-1:])))
    return names


def same_world(first: ViewerItem, second: ViewerItem) -> bool:
    """Whether two items share a world: a photograph has the same pose in both.

    True if the scene of either is unknown.
    """
    if not (first.scene and first.scene.images and second.scene):
        return True
    poses = {image.name: image.camera.world_from_cam for image in first.scene.images}
    return any(
        np.allclose(poses[image.name], image.camera.world_from_cam, rtol=1e-4, atol=1e-4)
        for image in second.scene.images
        if image.name in poses
    )


def viewer_frame(item: ViewerItem) -> TrainingFrame:
    """Training frame, or with fewer than two cameras a frame fitted to the model or the points."""
    scene = item.scene
    if scene is not None and len(scene.images) > 1:
        poses = camera_views(scene.split(item.test_every)[0])
        return frame_of_model(poses, reference_points(scene), item.gaussians)
    if item.gaussians is not None:
        xyz = item.gaussians.means.astype(np.float64)
    else:
        assert scene is not None  # noqa: S101  (there is a model or a scene)
        xyz = scene.points.xyz[scene.points.finite].astype(np.float64)
    if not len(xyz):
        return TrainingFrame(np.zeros(3), 1.0)
    origin = np.median(xyz, axis=0)
    reach = float(np.quantile(np.linalg.norm(xyz - origin, axis=1), CORE))
    return TrainingFrame(origin, 1 / reach if reach > 0 else 1.0)


def pinhole_view(
    size: tuple[int, int], fov: float, cam_from_world: Float64[np.ndarray, "4 4"]
) -> View:
    """Make a view without pixels of a width and height; ``fov`` is vertical, radians."""
    width, height = size
    focal = height / 2 / np.tan(fov / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return view_of(Camera(K, width, height, cam_from_world))


def split_picture(
    left: UInt8[np.ndarray, "H W 3"],
    right: UInt8[np.ndarray, "H W 3"],
    left_name: str = "",
    right_name: str = "",
    *,
    at: float = 0.5,
) -> UInt8[np.ndarray, "H W 3"]:
    """Join the left of one picture and the right of another, labelled, with a white border."""
    column, size = round(at * left.shape[1]), max(10, min(len(left) // 28, 28))
    pictures = []
    for picture, name, start in ((left, left_name, 0), (right, right_name, column)):
        image = PillowImage.fromarray(picture)
        ImageDraw.Draw(image).text(
            (start + size // 2, len(picture) - size // 2),
            latin(name),
            fill="white",
            font=font(size),
            anchor="ld",
            stroke_width=2,
            stroke_fill="black",
        )
        pictures.append(np.array(image))
    joined = np.concatenate([pictures[0][:, :column], pictures[1][:, column:]], axis=1)
    joined[:, max(column - LINE // 2, 0) : column + LINE // 2] = 255
    return joined
