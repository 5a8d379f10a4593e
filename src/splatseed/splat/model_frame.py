"""Detect a model's frame, and transform Gaussians to the scene's.

Some trainers normalise the scene before training and write Gaussians in that frame. Rendered from
the scene's cameras, they give wrong images and scores. The *misfit* of a model is the median
distance from the scene's points to the nearest Gaussian, in units of the median distance between
neighbouring Gaussians: about 1 in the right frame (0.1 to 1.3 for seeds and trained models of five
scenes), 4 to 700 in a wrong one. A model of a part of the scene, cropped by its user, is near the
points in its own box only: 0.7 to 1.3 there for crops of six scenes, 1.6 or more in wrong frames.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial import KDTree

from splatseed.camera import quat_from_rotation
from splatseed.errors import ParameterError, SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import read_json
from splatseed.io.matrices import NERFSTUDIO, similarity_in
from splatseed.io.nerfstudio import pair_centers
from splatseed.io.origin import find_shift, format_offset, offset_beside
from splatseed.photos.view import View
from splatseed.progress import Note, silent_note
from splatseed.scene import Scene
from splatseed.similarity import Similarity, fit_similarity, similarity_of
from splatseed.splat.gaussians import VISIBLE_LOGIT, Gaussians

GSPLAT, FLIPPED, TURNED, NO_TRANSFORM = "gsplat", "flipped", "turned", "none"
"""Named transforms: that of gsplat's examples; y and z, or x and y negated; none, unchecked."""
_NEGATED = {FLIPPED: (1.0, -1.0, -1.0), TURNED: (-1.0, -1.0, 1.0)}
FILES = (NERFSTUDIO, "cameras.json")
"""Files with a transform, in the model's folder or up to three above."""
_FIX = "Name another file, gsplat, flipped, turned or none."


@dataclass(frozen=True)
class FrameSettings:
    """Thresholds of the misfit, and sample sizes."""

    max_misfit: float = 8.0  # above it, the model is in another frame
    good_misfit: float = 1.5  # up to it, the model is in the right frame
    ratio: float = (
        3.0  # between them: another frame is right if its misfit is smaller by this factor
    )
    min_points: int = 20  # points, and Gaussians, needed to measure a misfit
    max_points: int = 3000  # points, and Gaussians, that are measured
    box: tuple[float, float] = (0.02, 0.98)  # quantiles of the Gaussians' positions that span it
    min_in_box: int = 50  # points in the box, needed to measure the misfit of a part of the scene


FRAME = FrameSettings()


def view_in_model_frame(world: Similarity | None, view: View) -> View:
    """Return a view of the scene with its pose in the model's frame."""
    if world is None:
        return view
    return view.posed(world.camera(view.cam_from_world))


def find_transform(name: str, scene: Scene) -> Similarity | None:
    """Return the transform from the scene's to the model's frame.

    ``name`` is a file, ``gsplat`` (computed from the scene), ``flipped`` (y and z are negated, from
    COLMAP's axes to OpenGL's), ``turned`` (x and y are, to glTF's) or ``none``, which gives None.

    Raises:
        SceneNotFoundError: The file does not exist.
        SceneFormatError: The file has no transform, or does not fit the scene.
        ParameterError: gsplat's transform cannot be computed for the scene.
    """
    if name == NO_TRANSFORM:
        return None
    if name == GSPLAT:
        return _gsplat_normalisation(scene)
    if name in _NEGATED:
        return _to_file_frame(scene).then(Similarity(1.0, np.diag(_NEGATED[name]), np.zeros(3)))
    path = Path(name)
    content = read_json(path, "a transform in JSON", fix=_FIX)
    if isinstance(content, list) and content and isinstance(content[0], dict):
        return _from_cameras_json(path, content, scene)
    world = similarity_in(path, content, scene, _FIX)  # a plain matrix, or nerfstudio's
    return _to_file_frame(scene).then(world)


def move_to_scene_origin(
    path: Path, scene: Scene, gaussians: Gaussians, note: Note = silent_note
) -> Gaussians:
    """Translate Gaussians, read from ``path``, to the origin of the loaded scene.

    The file's ``recenter.json`` gives the offset; without one it is inferred (``find_shift``), and
    ``note`` is called.
    """
    recorded = offset_beside(path)
    shift = find_shift(scene, gaussians.means, recorded, unrecorded=True)
    if not shift.any():
        return gaussians
    if recorded is None:
        note(
            Finding(
                "far-from-origin",
                f"The Gaussians of {path} were far from the scene's origin: they were moved by "
                f"{format_offset(shift)}.",
                subjects=(str(path),),
            )
        )
    return translate_gaussians(gaussians, shift)


def translate_gaussians(gaussians: Gaussians, shift: Float64[np.ndarray, " 3"]) -> Gaussians:
    """Translate Gaussians."""
    means = gaussians.means.astype(np.float64) + shift
    return dataclasses.replace(gaussians, means=means.astype(np.float32))


def check_frame(
    path: Path | None,
    scene: Scene,
    gaussians: Gaussians,
    given: Similarity | None = None,
    note: Note = silent_note,
) -> None:
    """Raise unless a model, read from ``path``, is in the scene's frame, or that of ``given``.

    ``note`` is called if the frame is uncertain. Without points nothing is checked.
    """
    misfit = _misfit_of(scene, gaussians)
    if misfit is None or (found := misfit(given)) <= FRAME.good_misfit:
        return
    misfits = {name: misfit(world) for name, world in _candidates(path, scene).items()}
    best = min(misfits, key=misfits.__getitem__)
    if found <= FRAME.max_misfit and found <= misfits[best] * FRAME.ratio:
        note(
            Finding(
                "uncertain-frame",
                f"Points of the scene are {found:.1f} times as far from the nearest Gaussian as "
                "Gaussians from each other: check the renders before you trust the scores.",
                fix=f"If they are wrong, try `transform={best!r}`, which fits better."
                if misfits[best] <= FRAME.good_misfit
                else "",
            )
        )
        return
    fix = (
        "No known transform fits: this is probably a model of another scene. Otherwise pass its "
        "trainer's transform as `transform=FILE`, or "
        f"`transform={NO_TRANSFORM!r}` to score the model unchanged."
    )
    fitting = [
        name
        for name, value in misfits.items()
        if value < found / FRAME.ratio and value <= FRAME.good_misfit
    ]
    if fitting:
        fix = (
            f"Pass `transform={fitting[0]!r}`, which fits, unless this is a model of another scene."
        )
    raise SceneFormatError(
        f"the Gaussians{f' of {path}' if path else ''} to be in the scene's frame, near its points",
        found=f"points {found:.0f} times as far from the nearest Gaussian as Gaussians from each "
        "other: another frame, or another scene",
        fix=fix,
    )


def move_to_scene_frame(
    path: Path, scene: Scene, gaussians: Gaussians, note: Note = silent_note
) -> Gaussians:
    """Transform Gaussians, read from ``path``, by ``scene_from_model``."""
    move = scene_from_model(path, scene, gaussians, note)
    return gaussians if move is None else transform_gaussians(gaussians, move)


def scene_from_model(
    path: Path, scene: Scene, gaussians: Gaussians, note: Note = silent_note
) -> Similarity | None:
    """Find the transform of Gaussians, read from ``path``, to the scene's frame.

    It is None for Gaussians that fit the scene's points, else the inverse of the best of the
    transforms that their trainer may have applied, on which ``note`` is called.
    """
    misfit = _misfit_of(scene, gaussians)
    if misfit is None or misfit(None) <= FRAME.good_misfit:
        return None
    misfits = {name: misfit(world) for name, world in _candidates(path, scene).items()}
    name = min(misfits, key=misfits.__getitem__)
    limit = min(FRAME.good_misfit, misfits[NO_TRANSFORM] / FRAME.ratio)
    if name == NO_TRANSFORM or misfits[name] > limit:
        try:
            check_frame(path, scene, gaussians, note=note)
        except SceneFormatError as error:
            fix = "Name the scene of the training, or transform the model to the scene's frame."
            raise SceneFormatError(error.expected, found=error.found, fix=fix) from None
        return None
    world = find_transform(name, scene)
    assert world is not None  # noqa: S101  (only `none` has no transform)
    text = f"The Gaussians of {path} were in their trainer's frame ({name})"
    note(
        Finding(
            "model-frame", f"{text} and were transformed to the scene's.", subjects=(str(path),)
        )
    )
    return world.inverse


def transform_gaussians(gaussians: Gaussians, similarity: Similarity) -> Gaussians:
    """Apply a similarity to Gaussians, with their harmonics."""
    rotation = quat_from_rotation(similarity.rotation)
    w, x, y, z = gaussians.quats.astype(np.float64).T
    a, b, c, d = rotation
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
    rotated = np.einsum(
        "jk,nkc->njc", _sh_rotation(similarity.rotation, harmonics.shape[1]), harmonics
    )
    return dataclasses.replace(
        gaussians,
        means=similarity.points(gaussians.means).astype(np.float32),
        scales=gaussians.scales + np.float32(np.log(similarity.scale)),
        quats=quats.astype(np.float32),
        shN=rotated[:, 1:].astype(np.float32),
    )


def _sh_rotation(rotation: Float64[np.ndarray, "3 3"], terms: int) -> Float64[np.ndarray, "K K"]:
    """Return the matrix M that rotates coefficients: y(d) M h = y(R' d) h for all directions d."""
    # `export --help` loads this module, and must not wait for PyTorch.
    from splatseed.rendering.harmonics import sh_basis  # noqa: PLC0415

    directions = np.random.default_rng(0).normal(size=(8 * terms, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    bases, rotated_bases = sh_basis(directions, terms), sh_basis(directions @ rotation, terms)
    return np.asarray(np.linalg.lstsq(bases, rotated_bases, rcond=None)[0])


def _misfit_of(scene: Scene, gaussians: Gaussians) -> Callable[[Similarity | None], float] | None:
    """Return a function from a transform to the misfit; None with too few points or Gaussians."""
    rng = np.random.default_rng(0)
    points = scene.points.references
    every = rng.permutation(points.xyz[points.finite].astype(np.float64))
    xyz = every[: FRAME.max_points]
    means = gaussians.means[gaussians.opacities > VISIBLE_LOGIT].astype(np.float64)
    if len(xyz) < FRAME.min_points or len(means) < FRAME.min_points:
        return None
    tree = KDTree(means)
    near = tree.query(rng.permutation(means)[: FRAME.max_points], k=2)[0][:, 1]
    gap = max(float(np.median(near)), float(np.finfo(np.float32).tiny))

    low, high = np.quantile(means, FRAME.box, axis=0)

    def misfit(world: Similarity | None) -> float:
        whole = float(np.median(tree.query(_moved(xyz, world))[0])) / gap
        if whole <= FRAME.good_misfit:
            return whole
        moved = _moved(every, world)
        inside = moved[((moved >= low) & (moved <= high)).all(axis=1)][: FRAME.max_points]
        if len(inside) < FRAME.min_in_box:
            return whole
        part = float(np.median(tree.query(inside)[0])) / gap
        return part if part <= FRAME.good_misfit else whole

    return misfit


def _moved(xyz: Float64[np.ndarray, "P 3"], world: Similarity | None) -> Float64[np.ndarray, "P 3"]:
    return xyz if world is None else world.points(xyz)


def _candidates(path: Path | None, scene: Scene) -> dict[str, Similarity | None]:
    """Return transforms that the model's trainer may have applied, by ``transform`` value."""
    found: dict[str, Similarity | None] = {NO_TRANSFORM: None}
    folders = path.resolve().parents[:4] if path else ()
    files = [folder / file for folder in folders for file in FILES]
    for name in (*(str(file) for file in files if file.is_file()), GSPLAT, *_NEGATED):
        with suppress(SceneFormatError, ParameterError):
            found[name] = find_transform(name, scene)
    return found


def _from_cameras_json(path: Path, cameras: list[Any], scene: Scene) -> Similarity:
    """Fit the similarity from the scene's cameras to those of graphdeco's ``cameras.json``.

    Its names are those of the images, in older versions without folder and suffix.
    """
    known = [(image.name, image.camera.center) for image in scene.images]
    try:
        placed = [(str(c["img_name"]), np.array(c["position"], np.float64)) for c in cameras]
        pairs = pair_centers(known, placed)
        source, target = (np.reshape(each, (-1, 3)) for each in zip(*pairs, strict=True))
    except (KeyError, TypeError, ValueError):
        source = target = np.empty((0, 3))
    world = fit_similarity(source, target)
    if world is None:
        raise SceneFormatError(
            f"{path} to have at least three images of the scene, not on a line",
            found=f"{len(source)} of its {len(scene.images)} images",
            fix=_FIX,
        )
    return world


def _to_file_frame(scene: Scene) -> Similarity:
    """Return the translation from the loaded scene to the frame of its files."""
    return Similarity(1.0, np.eye(3), scene.origin)


def _gsplat_normalisation(scene: Scene) -> Similarity:
    """Return the normalisation of gsplat's examples (1.5, examples/datasets/normalize.py).

    It depends on the origin of the files.
    """
    xyz = scene.points.xyz[scene.points.finite] + scene.origin
    if len(xyz) < 3 or not scene.images:
        raise ParameterError(
            "a scene with points and cameras, from which gsplat computes its transform",
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
    # Shift by the median of the points of the optical axes nearest to the origin; scale the median
    # camera distance to 1.
    forward = world_from_cam[:, :3, 2] @ rotation.T
    centers = world_from_cam[:, :3, 3] @ rotation.T
    nearest = centers - (forward * centers).sum(axis=1, keepdims=True) * forward
    shift = -np.median(nearest, axis=0)
    scale = 1.0 / np.median(np.linalg.norm(centers + shift, axis=1))
    first = scale * np.column_stack([rotation, shift])
    xyz1 = np.vstack([xyz.T, np.ones(len(xyz))])
    upright = first @ xyz1
    # Median of the points to 0, the axis of their smallest spread to z, the majority below.
    center = np.median(upright, axis=1)
    axes = np.linalg.eigh(np.cov(upright - center[:, None]))[1][:, ::-1].T.copy()
    axes[0] *= np.sign(np.linalg.det(axes))
    matrix = np.column_stack([axes, -axes @ center]) @ np.vstack([first, np.eye(4)[3:]])
    z = matrix[2] @ xyz1
    if np.median(z) > z.mean():
        matrix = np.diag([1.0, -1.0, -1.0]) @ matrix
    world = similarity_of(matrix)
    assert world is not None  # noqa: S101  (rotations and one scale)
    return _to_file_frame(scene).then(world)
