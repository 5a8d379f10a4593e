"""Refinement of poses that a device gave: off by centimetres and a degree or two.

Points are triangulated at the given poses, and bundle adjustment moves poses and points together;
what may count as an observation shrinks from round to round. Matches were verified pair by pair
without the poses, so they are right however far off the poses are. Lenses stay as they are given.
Given positions are priors whose noise is estimated from what remains: it holds the cameras that
few matches hold. Last, all poses are brought back to the given ones' frame and scale.

Notation: N cameras; ``rotations`` [N, 3, 3] are the upper left of ``cam_from_world`` in OpenCV
axes, ``centers`` [N, 3] are in scene units. A *turn* is the angle between two rotations of one
camera in degrees, a *shift* the distance of its two centres. px are pixels of the photographs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.errors import ReconstructionError
from splatseed.scene import Image
from splatseed.sfm.colmap import Run, posed_model, rigid
from splatseed.text import name_some

COARSE = (6.0, 2.0)
"""Degrees by which an observation may miss its point in the first rounds."""
FINE = (8.0, 4.0)
"""The same in px in the rounds after; the last, COLMAP's own, is repeated."""
MAX_ROUNDS, MAX_ITERATIONS = 12, 30
"""Iterations are of bundle adjustment in a round; the next goes on from there."""
STILL = 0.1
"""Poses are at rest when a round turns every camera by less than this, in px of its image."""
FIRST_NOISE = 0.03
"""Standard deviation of given positions that is assumed first, of the cameras' spread."""
MIN_NOISE, MIN_ERROR = 1e-4, 0.05
"""The smallest that is believed, and the smallest reprojection error, px."""
GAIN = 0.1
"""Given poses are kept when refinement lowers the mean reprojection error by less, in px."""
MIN_POINTS = 10
"""A photograph that sees fewer points takes no part: they pin its pose down too loosely."""
MIN_KEPT = 0.95
"""Observations that refined poses fit, of those that fit before: a few wrong ones always go."""
MAX_TURN, MAX_SHIFT = 10.0, 0.5
"""A camera that turned by more degrees has drifted, as devices err by one or two; likewise one that
moved by more, of the cameras' spread."""
_ALIGN_ROUNDS = 5  # of fitting the similarity and the noise in turn
_ALIGN_NOISE = 1e-9  # of the spread, and in radians: equal poses have none
_TYPICAL = 1.54  # median length of a 3-vector of standard normal numbers


@dataclass(frozen=True)
class Refinement:
    """What the refinement of given poses changed.

    Errors are in px of the photographs, for the observations that fit refined poses.
    """

    kept: bool  # refined ones would have lowered the error by less than 0.1 px: none changed
    error_before: float  # mean over points of their mean reprojection error at the given poses
    error_after: float  # the same at the scene's poses
    median_shift: float = 0.0  # over the cameras, how far each moved, scene units
    largest_shift: float = 0.0
    median_turn: float = 0.0  # over the cameras, the angle by which each turned, degrees
    largest_turn: float = 0.0


class Poses(NamedTuple):
    """Poses of N cameras: rotations of cam_from_world, and centres in the world, scene units."""

    rotations: Float64[np.ndarray, "N 3 3"]
    centers: Float64[np.ndarray, "N 3"]


def poses_of(images: Sequence[Image]) -> Poses:
    """The poses of ``images``, in their order."""
    cameras = [image.camera for image in images]
    rotations = np.array([camera.cam_from_world[:3, :3] for camera in cameras])
    return Poses(rotations, np.array([camera.center for camera in cameras]))


def with_poses(images: Sequence[Image], poses: Poses) -> list[Image]:
    """The ``images`` with other poses."""
    return [
        replace(image, quat=quat_from_rotation(rotation), translation=-rotation @ center)
        for image, rotation, center in zip(images, *poses, strict=True)
    ]


def turns(a: Poses, b: Poses) -> Float64[np.ndarray, " N"]:
    """Angle between ``a`` and ``b`` of each camera in degrees."""
    vectors = _turn_vectors(a.rotations, b.rotations)
    return np.asarray(np.degrees(np.linalg.norm(vectors, axis=1)))


def shifts(a: Poses, b: Poses) -> Float64[np.ndarray, " N"]:
    """Distance between ``a`` and ``b`` of each camera in scene units."""
    return np.asarray(np.linalg.norm(a.centers - b.centers, axis=1))


def spread(poses: Poses) -> float:
    """Root mean square distance of the cameras from their middle, in scene units."""
    return float(np.sqrt(np.square(poses.centers - poses.centers.mean(axis=0)).sum(axis=1).mean()))


def align(moved: Poses, given: Poses) -> Poses:
    """``moved`` in the world frame of ``given``, by one rotation, scale and translation.

    Rotations count as well as centres: cameras along a line say nothing of the roll about it.
    Each is weighed by its noise, which is estimated from the residuals, and a camera far from its
    given pose counts little. Given cameras must not all be in one place.
    """
    size, middle = spread(given), given.centers.mean(axis=0)
    mean = Rotation.from_matrix(given.rotations.transpose(0, 2, 1) @ moved.rotations).mean()
    centered = moved.centers - moved.centers.mean(axis=0)

    def after(x: Float64[np.ndarray, " 7"]) -> Poses:
        """``moved`` by a turn, a shift and the logarithm of a scale; at 0 by the mean rotation."""
        turn = (Rotation.from_rotvec(x[:3]) * mean).as_matrix().T
        centers = np.exp(x[6]) * (centered @ turn) + (middle + x[3:6] * size)
        return Poses(moved.rotations @ turn, centers)

    def residuals(x: Float64[np.ndarray, " 7"], noise: tuple[float, float]) -> Any:
        new = after(x)
        shift = (new.centers - given.centers) / (size * noise[0])
        return np.stack([shift, _turn_vectors(new.rotations, given.rotations) / noise[1]])

    x, noise = np.zeros(7), (0.02, 0.02)
    for _ in range(_ALIGN_ROUNDS):
        x = least_squares(lambda x: residuals(x, noise).ravel(), x, loss="soft_l1").x  # noqa: B023
        lengths = np.median(np.linalg.norm(residuals(x, (1.0, 1.0)), axis=2), axis=1) / _TYPICAL
        noise = (max(float(lengths[0]), _ALIGN_NOISE), max(float(lengths[1]), _ALIGN_NOISE))
    return after(x)


def _turn_vectors(
    a: Float64[np.ndarray, "N 3 3"], b: Float64[np.ndarray, "N 3 3"]
) -> Float64[np.ndarray, "N 3"]:
    return np.asarray(Rotation.from_matrix(a @ b.transpose(0, 2, 1)).as_rotvec())


def refine(run: Run, given: Sequence[Image]) -> tuple[list[Image], Refinement]:
    """Move the given poses to where the photographs' matches agree.

    Cameras that see fewer than 10 points stay where they are; all do, exactly, where the mean
    reprojection error would fall by less than 0.1 px.

    The run has verified matches of ``posed_model(given)``.

    Raises:
        ReconstructionError: Fewer than half of the photographs see points, or the poses drifted:
            fewer photographs or observations fit than before, a camera turned by more than 10
            degrees or moved by more than half of the cameras' root mean square distance from their
            middle.
    """
    solver = _Solver(run, given)
    poses, strict, after, before = run.stage(
        "refinement", solver.solve, lambda: solver.rounds, MAX_ROUNDS
    )
    names = np.array([image.name for image in given])
    if not _enough(after.seeing):
        raise _refused(
            f"at least half of the {len(names)} posed images to see {MIN_POINTS} points or more, "
            "so that their poses can be refined",
            f"{after.seeing.sum()}; too few in {name_some(names[~after.seeing].tolist())}",
        )
    if before.error - after.error < GAIN:
        return list(given), Refinement(True, before.error, before.error)
    lost = names[strict.seeing & ~after.seeing].tolist()
    if (
        after.seeing.sum() < strict.seeing.sum()
        or after.observations < MIN_KEPT * strict.observations
    ):
        raise _refused(
            f"refined poses to fit the {strict.seeing.sum()} images and {strict.observations:,} "
            "observations that the given poses fit",
            f"{after.seeing.sum()} (lost: {name_some(lost) or 'none'}) and {after.observations:,}",
        )
    old = poses_of(given)
    shift, turn, limit = shifts(poses, old), turns(poses, old), MAX_SHIFT * spread(old)
    drifted = np.flatnonzero((turn > MAX_TURN) | (shift > limit))
    if len(drifted):
        worst = int(drifted[np.argmax(turn[drifted] / MAX_TURN + shift[drifted] / limit)])
        raise _refused(
            f"refinement to turn no camera by more than {MAX_TURN:g} degrees nor move it by more "
            f"than {limit:.3g} scene units, half of the cameras' spread",
            f"{turn[worst]:.1f} degrees and {shift[worst]:.3g} units in {names[worst]}, and "
            f"{len(drifted)} of {len(names)} such images: {name_some(names[drifted].tolist())}",
        )
    moves = [float(each) for of in (shift, turn) for each in (np.median(of), of.max())]
    return with_poses(given, poses), Refinement(False, before.error, after.error, *moves)


def _refused(expected: str, found: str) -> ReconstructionError:
    fix = (
        "Check that the poses belong to these images, in the same order and convention; take out "
        "the images named; or leave refine_poses out, which keeps the poses."
    )
    return ReconstructionError(expected, found=found, fix=fix)


class _Fit(NamedTuple):
    """How photographs and points agree."""

    seeing: Bool[np.ndarray, " N"]  # which photographs see enough points to take part
    observations: int
    error: float  # mean over the points of their mean reprojection error, px; inf without any


def _enough(seeing: Bool[np.ndarray, " N"]) -> bool:
    """Whether half of the photographs take part."""
    return bool(2 * seeing.sum() >= len(seeing) and seeing.sum() >= 2)


class _Solver:
    """Rounds of triangulation and bundle adjustment; arguments as ``refine`` has them."""

    def __init__(self, run: Run, images: Sequence[Image]) -> None:
        self.rounds = 0
        self._run, self._pycolmap = run, run.pycolmap
        self._images, self._given = images, poses_of(images)
        self._model = posed_model(run.pycolmap, images)
        self._ids = range(1, len(images) + 1)
        lenses = self._model.cameras.values()
        self._focal = float(np.median([lens.mean_focal_length() for lens in lenses]))

    def solve(self) -> tuple[Poses, _Fit, _Fit, _Fit]:
        """Refine until the poses rest.

        Returns the poses in the given frame, the fit of what can be triangulated at the given
        poses, the fit at the new ones, and that of the same observations at the given ones.
        """
        pycolmap, size = self._pycolmap, spread(self._given)
        with pycolmap.Database.open(self._run.database) as database:
            cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(self._model)
        strict = self._round(mapper, FINE[-1], None)
        noise, poses = FIRST_NOISE * size, self._given
        coarse = [self._focal * math.tan(math.radians(degrees)) for degrees in COARSE]
        limits = [*(max(pixels, FINE[0]) for pixels in coarse), *FINE]
        for pixels in limits + [FINE[-1]] * (MAX_ROUNDS - len(limits)):
            fit = self._round(mapper, pixels, noise)
            if not _enough(fit.seeing):
                break
            old, poses = poses, self._aligned(fit.seeing)
            # A little too large on purpose: a prior too tight would prove itself right
            noise = max(float(np.median(shifts(poses, self._given))), MIN_NOISE * size)
            noise /= max(fit.error, MIN_ERROR)  # adjustment takes features' noise for 1 px
            self.rounds += 1
            if pixels == FINE[-1] and np.radians(turns(poses, old).max()) * self._focal < STILL:
                break
        after = self._fit()
        for image_id, image in zip(self._ids, self._images, strict=True):
            self._model.image(image_id).frame.rig_from_world = rigid(pycolmap, image)
        self._adjust(FINE[-1], None)
        mapper.observation_manager.filter_observations_with_negative_depth()
        return poses, strict, after, self._fit()

    def _round(self, mapper: Any, pixels: float, noise: float | None) -> _Fit:
        """Triangulate, adjust, and drop what misses its point by more than ``pixels``."""
        options = self._pycolmap.IncrementalTriangulatorOptions(
            merge_max_reproj_error=pixels,
            complete_max_reproj_error=pixels,
            max_extra_param=math.inf,  # a known lens is trusted
            random_seed=self._run.settings.seed,
        )
        degrees = math.degrees(math.atan(pixels / self._focal))
        for name in ("create_max_angle_error", "continue_max_angle_error", "re_max_angle_error"):
            setattr(options, name, max(degrees, getattr(options, name)))
        for image_id in self._ids:
            mapper.triangulate_image(options, image_id)
        mapper.complete_and_merge_tracks(options)
        mapper.retriangulate(options)
        self._adjust(pixels, noise)
        least = self._pycolmap.IncrementalMapperOptions().filter_min_tri_angle
        mapper.observation_manager.filter_all_points3D(pixels, least)
        return self._fit()

    def _adjust(self, pixels: float, noise: float | None) -> None:
        """Adjust points, and poses too if the ``noise`` of given positions is told."""
        if self._model.num_points3D() == 0:
            return
        pycolmap, settings = self._pycolmap, self._run.settings
        cauchy = pycolmap.LossFunctionType.CAUCHY
        options = pycolmap.BundleAdjustmentOptions(
            refine_focal_length=False,
            refine_extra_params=False,
            refine_sensor_from_rig=False,
            refine_rig_from_world=noise is not None,
            print_summary=False,
        )
        options.ceres.loss_function_type, options.ceres.loss_function_scale = cauchy, pixels / 4
        options.ceres.solver_options.function_tolerance = 1e-6
        options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
        options.ceres.solver_options.num_threads = settings.threads
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in self._ids:
            config.add_image(image_id)
        for camera_id in self._model.cameras:
            config.set_constant_cam_intrinsics(camera_id)
        if noise is None:
            pycolmap.create_default_bundle_adjuster(options, config, self._model).solve()
            return
        of_priors = pycolmap.PosePriorBundleAdjustmentOptions(
            ceres={"prior_position_loss_function_type": cauchy},
            alignment_ransac={"random_seed": settings.seed},
        )
        priors = [
            pycolmap.PosePrior(
                pose_prior_id=image_id,
                corr_data_id=self._model.image(image_id).data_id,
                position=center,
                position_covariance=noise**2 * np.eye(3),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
            for image_id, center in zip(self._ids, self._given.centers, strict=True)
        ]
        pycolmap.create_pose_prior_bundle_adjuster(
            options, of_priors, config, priors, self._model
        ).solve()

    def _aligned(self, seeing: Bool[np.ndarray, " N"]) -> Poses:
        """The model's poses in the given frame; given ones where a photograph sees no point."""
        matrices = [self._model.image(i).cam_from_world().matrix() for i in self._ids]
        found = np.array([matrix[:, :3] for matrix in matrices])
        found_centers = np.array([-matrix[:, :3].T @ matrix[:, 3] for matrix in matrices])
        rotations, centers = self._given.rotations.copy(), self._given.centers.copy()
        rotations[seeing], centers[seeing] = align(
            Poses(found[seeing], found_centers[seeing]), Poses(rotations[seeing], centers[seeing])
        )
        return Poses(rotations, centers)

    def _fit(self) -> _Fit:
        self._model.update_point_3d_errors()
        points = self._model.num_points3D()
        return _Fit(
            np.array([self._model.image(i).num_points3D >= MIN_POINTS for i in self._ids]),
            self._model.compute_num_observations(),
            float(self._model.compute_mean_reprojection_error()) if points else math.inf,
        )
