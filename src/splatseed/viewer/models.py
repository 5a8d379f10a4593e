"""What a user names to look at: a scene, a run, or a file of Gaussians; and its stage.

Notation: the *stage* is the world moved and scaled so that near planes and single precision work:
the training frame if the scene is known, else one fitted to what is shown. Promise: a file's
content decides what it is; a model knows its scene if the run or the user names it.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, UInt8
from PIL import Image as PillowImage, ImageDraw

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.files import StrPath, read_bytes
from splatseed.photos.sight import shown_points
from splatseed.photos.view import View, poses_of
from splatseed.scene import Scene
from splatseed.splat.formats import detect_format, read_gaussians
from splatseed.splat.gaussians import Gaussians, TrainingFrame, frame_of_model
from splatseed.splat.world import around_scene
from splatseed.text import quoted
from splatseed.training.folder import RunFolder
from splatseed.viewer.page import font, latin

MODEL_SUFFIXES = (".spz", ".splat", ".sog", ".ksplat", ".glb")
_HEADER = 1 << 16
CORE = 0.6
"""Share of the points, nearest to their median, that the stage is fitted to without cameras."""
LINE = 2  # the border between two pictures


@dataclass(frozen=True, eq=False)
class Shown:
    """What a viewer shows: a scene, a model, or a model with its scene, in the scene's world.

    ``data_factor`` downsampled the photographs of the model's run; every ``test_every``-th image,
    sorted by name, is a test view. ``notes`` says what of the model was left out or changed on
    reading.
    """

    name: str
    scene: Scene | None = None
    gaussians: Gaussians | None = None
    data_factor: int = 1
    test_every: int = 8
    notes: tuple[str, ...] = ()

    @property
    def model(self) -> Gaussians:
        """The Gaussians, where there are some."""
        assert self.gaussians is not None  # noqa: S101  (whoever asks has checked)
        return self.gaussians

    @property
    def train_views(self) -> tuple[View, ...]:
        """The training cameras, as large as the run's photographs; none without a scene."""
        images = self.scene.split(self.test_every)[0] if self.scene else ()
        return poses_of(images, self.data_factor)

    @property
    def usual_views(self) -> tuple[View, ...]:
        """The training cameras without those that stray from all others."""
        views, strays = self.train_views, stage_frame(self).strays
        return tuple(view for view in views if view.name not in strays)


def open_shown(path: StrPath, scene_path: Path | None = None) -> Shown:
    """Read what a user names: a scene, a run folder, or a file of Gaussians or points.

    A model's scene is that at ``scene_path``, by default the one that its run names, if it exists.

    Raises:
        SceneNotFoundError: ``path``, or the scene that the user names, does not exist.
        SceneFormatError: It is damaged, or cannot be shown.
    """
    path = Path(path)

    def scene_at(place: Path | None) -> Scene | None:
        return None if place is None else load_scene(place, require_points=False)

    folder, notes = RunFolder(path), list[str]()
    if not path.is_dir() or not folder.is_run:
        if path.is_file() and _is_model(path):
            gaussians, scene = read_gaussians(path, notes.append), scene_at(scene_path)
            if scene is not None:
                gaussians = around_scene(path, scene, gaussians, notes.append)
            return Shown(path.name, scene, gaussians, notes=tuple(notes))
        bare = load_scene(path, require_points=False)
        if not bare.images and not len(bare.points):
            raise SceneFormatError(
                f"something to show at {path}",
                found="no images, points or Gaussians",
                fix="Name a scene, a run, or a file of points or Gaussians.",
            )
        return Shown(path.name, bare)
    if not folder.gaussians.is_file():
        raise SceneNotFoundError(
            f"{folder.path} to be a finished run of splatseed train",
            found="a run that has not finished",
            fix=f"Continue it: splatseed train SCENE -o {quoted(folder.path)} --resume.",
        )
    config, scene = folder.read_config(), scene_at(scene_path)
    named = folder.scene_of(config)
    if scene is None and named is not None:
        with suppress(SceneNotFoundError, SceneFormatError):  # it is gone
            scene = scene_at(Path(named))
    factor, every = (int(config.get(n) or d) for n, d in (("data_factor", 1), ("test_every", 8)))
    gaussians = read_gaussians(folder.gaussians, notes.append)
    if scene is not None:
        gaussians = around_scene(folder.gaussians, scene, gaussians, notes.append)
    return Shown(folder.path.name, scene, gaussians, factor, every, tuple(notes))


def names_of(paths: Sequence[Path]) -> list[str]:
    """A name for each path: its own, after as many of its folders as tell it from the others."""
    wholes = [path.absolute().parts for path in paths]
    names = []
    for whole in wholes:
        ends = (whole[start:] for start in reversed(range(len(whole))))
        own = (end for end in ends if sum(each[-len(end) :] == end for each in wholes) == 1)
        names.append("/".join(next(own, whole[-1:])))
    return names


def _is_model(path: Path) -> bool:
    """Whether a file holds Gaussians: a .ply of points is a scene."""
    if path.suffix.lower() in MODEL_SUFFIXES:
        return True
    data = read_bytes(path)
    if path.suffix.lower() == ".json" and b'"means"' not in data[:_HEADER]:
        return False
    try:
        kind = detect_format(path, data)
    except SceneFormatError:
        return False
    return kind != "ply" or b" scale_0\n" in data[:_HEADER].replace(b"\r", b"")


def share_a_world(first: Shown, second: Shown) -> bool:
    """Whether the cameras of one also see the other: a photograph has the same pose in both.

    Also where the scene of one is unknown, as nothing speaks against it.
    """
    if not (first.scene and first.scene.images and second.scene):
        return True
    poses = {image.name: image.camera.world_from_cam for image in first.scene.images}
    return any(
        np.allclose(poses[image.name], image.camera.world_from_cam, rtol=1e-4, atol=1e-4)
        for image in second.scene.images
        if image.name in poses
    )


def stage_frame(shown: Shown) -> TrainingFrame:
    """The training frame or, with fewer than two cameras, one fitted to the model or the points."""
    scene = shown.scene
    if scene is not None and len(scene.images) > 1:
        poses = poses_of(scene.split(shown.test_every)[0])
        return frame_of_model(poses, shown_points(scene), shown.gaussians)
    if shown.gaussians is not None:
        xyz = shown.gaussians.means.astype(np.float64)
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
    """A view without pixels, of this width and height; the field of view is vertical, radians."""
    width, height = size
    focal = height / 2 / np.tan(fov / 2)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    return View("", np.empty((0, 0, 3), np.uint8), K, width, height, cam_from_world)


def split_picture(
    left: UInt8[np.ndarray, "H W 3"],
    right: UInt8[np.ndarray, "H W 3"],
    left_name: str = "",
    right_name: str = "",
    *,
    at: float = 0.5,
) -> UInt8[np.ndarray, "H W 3"]:
    """The left of one picture and the right of another, labelled, with a white line between."""
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
