"""The world of a trained model, which need not be its scene's.

Some trainers normalise the world before training, and write Gaussians in that world; rendered from
the scene's cameras these give wrong pictures, and wrong scores without a warning. *Apart* is the
median distance from the scene's points to the nearest Gaussian, in units of the median distance
between neighbouring Gaussians: in the right world about 1 (0.1 to 1.3 for seeds and trained models
of five scenes), in a wrong one 4 to 700.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.camera import quat_from_rotation
from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.files import read_json
from splatseed.io.nerfstudio import NERFSTUDIO, similarity_in
from splatseed.io.origin import find_shift, format_offset, offset_beside
from splatseed.photos.view import View
from splatseed.scene import Scene
from splatseed.similarity import Similarity, fit_similarity, similarity_of
from splatseed.splat.gaussians import Gaussians

GSPLAT, NO_TRANSFORM = "gsplat", "none"
"""Words that name a transform: that of gsplat's examples, and none, without any check."""
APART, DOUBTFUL, CLOSER = 8.0, 1.5, 3.0
"""Gaussians farther apart than the first are in another world; beyond the second, too, if another
world is closer by the third as a factor."""
LEAST, SAMPLES = 20, 3000
"""Fewest and most points and Gaussians whose distances are measured."""
VISIBLE = -2.2  # logit of the least opacity that counts, a tenth
FILES = (NERFSTUDIO, "cameras.json")
"""Files of nerfstudio and graphdeco, in the model's folder or up to three above, that give a
transform."""
_FIX = "Name another file, or a word: gsplat, none."


def view_in_model_frame(world: Similarity | None, view: View) -> View:
    """A view of the scene, posed in the model's world."""
    if world is None:
        return view
    return view.posed(world.camera(view.cam_from_world))


def find_transform(word: str, scene: Scene) -> Similarity | None:
    """The transform that a user names: a file, or ``gsplat``; None for ``none``.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It holds no transform, or does not fit the scene.
        ParameterError: gsplat's cannot be computed for the scene.
    """
    if word == NO_TRANSFORM:
        return None
    if word == GSPLAT:
        return _of_gsplat(scene)
    path = Path(word)
    content = read_json(path, "a transform in JSON", fix=_FIX)
    if isinstance(content, list) and content and isinstance(content[0], dict):
        return _of_cameras(path, content, scene)
    world = similarity_in(path, content, scene, _FIX)  # a matrix, or nerfstudio's
    return _in_files(scene).then(world)


def move_to_scene_origin(
    path: Path, scene: Scene, gaussians: Gaussians, note: Callable[[str], None] = lambda _: None
) -> Gaussians:
    """Gaussians, read from a path, moved to the origin that the scene is worked on around.

    The offset is the one beside the file, else that of ``find_shift``; ``note`` tells a guess.
    """
    recorded = offset_beside(path)
    shift = find_shift(scene, gaussians.means, recorded, unrecorded=True)
    if not shift.any():
        return gaussians
    if recorded is None:
        note(f"The Gaussians of {path} lie far from the scene's origin: {_moved_by(shift)}.")
    return translate_gaussians(gaussians, shift)


def _moved_by(shift: Float64[np.ndarray, " 3"]) -> str:
    return f"they were moved by {format_offset(shift)} to it"


def translate_gaussians(gaussians: Gaussians, shift: Float64[np.ndarray, " 3"]) -> Gaussians:
    """The Gaussians moved by a shift."""
    means = gaussians.means.astype(np.float64) + shift
    return dataclasses.replace(gaussians, means=means.astype(np.float32))


def check_frame(
    path: Path | None, scene: Scene, gaussians: Gaussians, given: Similarity | None = None
) -> str:
    """Refuse a model, read from a path, that is not in the world of the scene's points.

    With ``given``, the transform that the user named, it must be in that world. Returns why it is
    doubtful that it is, in a sentence; empty if it is not, or without points.
    """
    apart = _measure(scene, gaussians)
    if apart is None or (ratio := apart(given)) <= DOUBTFUL:
        return ""
    ratios = {word: apart(world) for word, world in _candidates(path, scene).items()}
    if ratio <= APART and ratio <= min(ratios.values()) * CLOSER:
        return (
            f"Points of the scene are {ratio:.1f} times as far from the nearest Gaussian as "
            "Gaussians from each other: look at the renders before you trust the scores."
        )
    fix = (
        "No known transform fits: probably it is a model of another scene. Else name the "
        "transform that its trainer applied as `transform=FILE`; "
        f"to score it as it is, pass `transform={NO_TRANSFORM!r}`."
    )
    fitting = [w for w, each in ratios.items() if each < ratio / CLOSER and each <= DOUBTFUL]
    if fitting:
        fix = f"They fit with `transform={fitting[0]!r}`, unless it is a model of another scene."
    raise SceneFormatError(
        f"the Gaussians{f' of {path}' if path else ''} in the world of the scene, where its points "
        "are",
        found=f"points {ratio:.0f} times as far from the nearest Gaussian as Gaussians from each "
        "other: another frame, or another scene",
        fix=fix,
    )


def move_to_scene_frame(path: Path, scene: Scene, gaussians: Gaussians) -> tuple[Gaussians, str]:
    """Gaussians, read from a path, brought into the scene's world, and what there is to say.

    They are moved if a transform that their trainer may have applied puts them where the scene's
    points are, and they are not there already.

    Raises:
        SceneFormatError: They are in no known world of the scene.
    """
    apart = _measure(scene, gaussians)
    if apart is None or apart(None) <= DOUBTFUL:
        return gaussians, ""
    ratios = {word: apart(world) for word, world in _candidates(path, scene).items()}
    word = min(ratios, key=ratios.__getitem__)
    if word == NO_TRANSFORM or ratios[word] > min(DOUBTFUL, ratios[NO_TRANSFORM] / CLOSER):
        try:
            return gaussians, check_frame(path, scene, gaussians)
        except SceneFormatError as error:
            fix = "Name the scene that they were trained on, or move them into its world."
            raise SceneFormatError(error.expected, found=error.found, fix=fix) from None
    world = find_transform(word, scene)
    assert world is not None  # noqa: S101  (only the word none has no transform)
    return transform_gaussians(gaussians, world.inverse), (
        f"The Gaussians of {path} are in their trainer's own world ({word}) and were moved into "
        "the scene's."
    )


def transform_gaussians(gaussians: Gaussians, similarity: Similarity) -> Gaussians:
    """The Gaussians in the similarity's target; their harmonics turn with them."""
    turn = quat_from_rotation(similarity.rotation)
    w, x, y, z = gaussians.quats.astype(np.float64).T
    a, b, c, d = turn
    # The product of quaternions: first the Gaussian's rotation, then the similarity's.
    quats = np.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=1,
    )
    harmonics = np.concatenate([gaussians.sh0, gaussians.shN], axis=1)
    turned = np.einsum("jk,nkc->njc", _turning(similarity.rotation, harmonics.shape[1]), harmonics)
    return dataclasses.replace(
        gaussians,
        means=similarity.points(gaussians.means).astype(np.float32),
        scales=gaussians.scales + np.float32(np.log(similarity.scale)),
        quats=quats.astype(np.float32),
        shN=turned[:, 1:].astype(np.float32),
    )


def _turning(rotation: Float64[np.ndarray, "3 3"], terms: int) -> Float64[np.ndarray, "K K"]:
    """The matrix that turns coefficients: y(d) M h = y(R' d) h for every direction d."""
    import torch  # noqa: PLC0415  (takes a while)
    from gsplat.cuda._torch_impl import _eval_sh_bases_fast  # noqa: PLC0415

    directions = np.random.default_rng(0).normal(size=(8 * terms, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here, there = (
        _eval_sh_bases_fast(terms, torch.from_numpy(np.ascontiguousarray(each))).numpy()
        for each in (directions, directions @ rotation)
    )
    return np.asarray(np.linalg.lstsq(here, there, rcond=None)[0])


def _measure(scene: Scene, gaussians: Gaussians) -> Callable[[Similarity | None], float] | None:
    """A function from a transform to how far apart points and Gaussians are; None with too few."""
    from scipy.spatial import KDTree  # noqa: PLC0415  (slow to import)

    rng = np.random.default_rng(0)
    points = scene.points.references
    xyz = rng.permutation(points.xyz[points.finite].astype(np.float64))[:SAMPLES]
    means = gaussians.means[gaussians.opacities > VISIBLE].astype(np.float64)
    if len(xyz) < LEAST or len(means) < LEAST:
        return None
    tree = KDTree(means)
    near = tree.query(rng.permutation(means)[:SAMPLES], k=2)[0][:, 1]
    gap = max(float(np.median(near)), float(np.finfo(np.float32).tiny))

    def apart(world: Similarity | None) -> float:
        moved = xyz if world is None else world.points(xyz)
        return float(np.median(tree.query(moved)[0])) / gap

    return apart


def _candidates(path: Path | None, scene: Scene) -> dict[str, Similarity | None]:
    """Transforms that the model's trainer may have applied, by the values of ``transform``."""
    found: dict[str, Similarity | None] = {NO_TRANSFORM: None}
    folders = path.resolve().parents[:4] if path else ()
    files = [folder / name for folder in folders for name in FILES]
    for word in (*(str(file) for file in files if file.is_file()), GSPLAT):
        with suppress(SceneFormatError, ParameterError):
            found[word] = find_transform(word, scene)
    return found


def _of_cameras(path: Path, cameras: list[Any], scene: Scene) -> Similarity:
    """The similarity that takes the scene's cameras to those of graphdeco's ``cameras.json``."""
    known = {PurePosixPath(image.name).stem: image.camera.center for image in scene.images}
    try:
        placed = [(PurePosixPath(str(c["img_name"])).stem, c["position"]) for c in cameras]
        pairs = [(known[name], np.array(at, np.float64)) for name, at in placed if name in known]
        source, target = (np.reshape(each, (-1, 3)) for each in zip(*pairs, strict=True))
    except (KeyError, TypeError, ValueError):
        source = target = np.empty((0, 3))
    world = fit_similarity(source, target)
    if world is None:
        raise SceneFormatError(
            f"{path} to place at least three images of the scene, not on a line",
            found=f"{len(source)} of its {len(scene.images)} images",
            fix=_FIX,
        )
    return world


def _in_files(scene: Scene) -> Similarity:
    """From the scene's positions to those of its files."""
    return Similarity(1.0, np.eye(3), scene.origin)


def _of_gsplat(scene: Scene) -> Similarity:
    """How gsplat's examples (1.5, examples/datasets/normalize.py) normalise a COLMAP scene.

    It depends on where the origin of the files is.
    """
    xyz = scene.points.xyz[scene.points.finite] + scene.origin
    if len(xyz) < 3 or not scene.images:
        raise ParameterError(
            "a scene with points and cameras, of which gsplat computes its transform",
            found=f"{len(xyz)} points, {len(scene.images)} cameras",
            fix="Name a file with the transform.",
        )
    world_from_cam = np.stack([image.camera.world_from_cam for image in scene.images])
    world_from_cam[:, :3, 3] += scene.origin
    # Mean up direction to -y, by Rodrigues' rotation that takes one unit vector to another.
    up = -world_from_cam[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    skew = np.cross(np.eye(3), np.cross(up, [0.0, -1.0, 0.0]))
    rotation = np.diag([-1.0, 1.0, 1.0])
    if up[1] < 1:
        rotation = np.eye(3) + skew + skew @ skew / (1 - up[1])
    # The point that cameras look at to 0, of each axis the nearest to the origin; median camera
    # distance to 1.
    forward = world_from_cam[:, :3, 2] @ rotation.T
    centers = world_from_cam[:, :3, 3] @ rotation.T
    nearest = centers - (forward * centers).sum(axis=1, keepdims=True) * forward
    shift = -np.median(nearest, axis=0)
    scale = 1.0 / np.median(np.linalg.norm(centers + shift, axis=1))
    first = scale * np.column_stack([rotation, shift])
    xyz1 = np.vstack([xyz.T, np.ones(len(xyz))])
    upright = first @ xyz1
    # The median of the points to 0, the axis of their least spread to z, most of them below.
    center = np.median(upright, axis=1)
    axes = np.linalg.eigh(np.cov(upright - center[:, None]))[1][:, ::-1].T.copy()
    axes[0] *= np.sign(np.linalg.det(axes))
    matrix = np.column_stack([axes, -axes @ center]) @ np.vstack([first, np.eye(4)[3:]])
    z = matrix[2] @ xyz1
    if np.median(z) > z.mean():
        matrix = np.diag([1.0, -1.0, -1.0]) @ matrix
    world = similarity_of(matrix)
    assert world is not None  # noqa: S101  (rotations and one scale)
    return _in_files(scene).then(world)
