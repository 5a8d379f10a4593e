"""Refine the poses of a device, which are off by centimetres and one or two degrees.

Points are triangulated at the given poses; bundle adjustment then moves poses and points, with an
outlier threshold that decreases from round to round. Matches do not depend on the poses, since they
were verified pairwise. Intrinsics are fixed. Given positions are priors, with noise estimated from
residuals, to constrain cameras with few matches. Finally all poses are aligned to the frame and
scale of the given ones.

Notation: N cameras; ``rotations`` [N, 3, 3] of ``cam_from_world`` in OpenCV axes; ``centers``
[N, 3] in scene units. A *turn* is the angle in degrees between two rotations of a camera, a *shift*
the distance between two of its centres. px are pixels of the photographs.
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
from splatseed.findings import Finding
from splatseed.scene import Image
from splatseed.sfm.colmap import ColmapRun, posed_model, rigid
from splatseed.text import counted, name_some


@dataclass(frozen=True)
class RefinementLimits:
    """Thresholds of refinement; lengths are relative to the cameras' spread."""

    coarse: tuple[float, ...] = (6.0, 2.0)
    """Outlier thresholds of the first rounds, degrees."""
    fine: tuple[float, ...] = (8.0, 4.0)
    """Outlier thresholds of the later rounds, px; the last, COLMAP's default, is repeated."""
    max_rounds: int = 12
    max_iterations: int = 30
    """Bundle adjustment iterations per round; the next round continues from there."""
    converged: float = 0.1
    """Refinement ends when a round rotates every camera by less, px of its image."""
    first_noise: float = 0.03
    """Initial standard deviation of given positions."""
    min_noise: float = 1e-4
    """Smallest estimate of that deviation."""
    min_error: float = 0.05
    """Smallest assumed reprojection error, px."""
    min_gain: float = 0.1
    """Given poses are kept if the mean reprojection error falls by less, px."""
    min_points: int = 10
    """A photograph with fewer points is excluded: its pose is under-constrained."""
    min_kept: float = 0.95
    """Smallest share of observations that must still fit; a few outliers are always lost."""
    max_turn: float = 10.0
    """Larger rotations are drift, degrees: devices err by one or two."""
    max_shift: float = 0.5
    """Larger shifts are drift."""
    align_rounds: int = 5
    """Alternations of fitting the similarity and its noise."""
    align_noise: float = 1e-9
    """Smallest noise of the alignment, also in radians: equal poses have none."""


LIMITS = RefinementLimits()
_NORMAL_MEDIAN = 1.54  # median length of a 3-vector of standard normal numbers


@dataclass(frozen=True)
class Refinement:
    """Changes by refinement; errors in px, for the observations that fit the refined poses."""

    kept: bool  # poses are unchanged: refinement gains less than 0.1 px
    error_before: float  # mean reprojection error over points at the given poses
    error_after: float  # the same at the resulting poses
    median_shift: float = 0.0  # over cameras, scene units
    largest_shift: float = 0.0
    median_turn: float = 0.0  # over cameras, degrees
    largest_turn: float = 0.0
    excluded: tuple[str, ...] = ()  # images that see too few points, whose poses are unchanged


class Poses(NamedTuple):
    """Rotations of ``cam_from_world`` and camera centres (scene units) of N cameras."""

    rotations: Float64[np.ndarray, "N 3 3"]
    centers: Float64[np.ndarray, "N 3"]


def poses_of(images: Sequence[Image]) -> Poses:
    """Return the poses of images, in order."""
    cameras = [image.camera for image in images]
    rotations = np.array([camera.cam_from_world[:3, :3] for camera in cameras])
    return Poses(rotations, np.array([camera.center for camera in cameras]))


def with_poses(images: Sequence[Image], poses: Poses) -> list[Image]:
    """Replace the poses of images."""
    return [
        replace(image, quat=quat_from_rotation(rotation), translation=-rotation @ center)
        for image, rotation, center in zip(images, *poses, strict=True)
    ]


def turns(a: Poses, b: Poses) -> Float64[np.ndarray, " N"]:
    """Return the angle between ``a`` and ``b`` of each camera, degrees."""
    vectors = _turn_vectors(a.rotations, b.rotations)
    return np.asarray(np.degrees(np.linalg.norm(vectors, axis=1)))


def shifts(a: Poses, b: Poses) -> Float64[np.ndarray, " N"]:
    """Return the distance between ``a`` and ``b`` of each camera, scene units."""
    return np.asarray(np.linalg.norm(a.centers - b.centers, axis=1))


def spread(poses: Poses) -> float:
    """Return the RMS distance of the cameras from their centroid, scene units."""
    return float(np.sqrt(np.square(poses.centers - poses.centers.mean(axis=0)).sum(axis=1).mean()))


def align_poses(moved: Poses, given: Poses) -> Poses:
    """Align ``moved`` to the world frame of ``given`` by a robust similarity.

    Residuals are of rotations and centres (centres along a line do not determine the roll about
    it), each divided by its noise, which is estimated alternately. Given centres must not coincide.
    """
    size, middle = spread(given), given.centers.mean(axis=0)
    mean = Rotation.from_matrix(given.rotations.transpose(0, 2, 1) @ moved.rotations).mean()
    centered = moved.centers - moved.centers.mean(axis=0)

    def after(x: Float64[np.ndarray, " 7"]) -> Poses:
        """Apply a rotation vector, a shift and a log scale on top of the mean rotation."""
        turn = (Rotation.from_rotvec(x[:3]) * mean).as_matrix().T
        centers = np.exp(x[6]) * (centered @ turn) + (middle + x[3:6] * size)
        return Poses(moved.rotations @ turn, centers)

    def residuals(x: Float64[np.ndarray, " 7"], noise: tuple[float, float]) -> Any:
        new = after(x)
        shift = (new.centers - given.centers) / (size * noise[0])
        return np.stack([shift, _turn_vectors(new.rotations, given.rotations) / noise[1]])

    x, noise = np.zeros(7), (0.02, 0.02)
    for _ in range(LIMITS.align_rounds):
        x = least_squares(lambda x: residuals(x, noise).ravel(), x, loss="soft_l1").x  # noqa: B023
        lengths = np.median(np.linalg.norm(residuals(x, (1.0, 1.0)), axis=2), axis=1)
        shift, turn = np.maximum(lengths / _NORMAL_MEDIAN, LIMITS.align_noise).tolist()
        noise = (shift, turn)
    return after(x)


def _turn_vectors(
    a: Float64[np.ndarray, "N 3 3"], b: Float64[np.ndarray, "N 3 3"]
) -> Float64[np.ndarray, "N 3"]:
    return np.asarray(Rotation.from_matrix(a @ b.transpose(0, 2, 1)).as_rotvec())


def refine(run: ColmapRun, given: Sequence[Image]) -> tuple[list[Image], Refinement]:
    """Refine given poses by the verified matches of ``posed_model(given)`` in the run.

    Cameras with fewer than 10 points are unchanged; so are all, if the mean reprojection error
    would fall by less than 0.1 px.
    """
    solver = _Solver(run, given)
    poses, strict, after, before = run.stage(
        "refinement", solver.solve, lambda: solver.rounds, LIMITS.max_rounds
    )
    names = np.array([image.name for image in given])
    if not _enough(after.seeing):
        raise _refused(
            f"at least half of the {len(names)} posed images to see {LIMITS.min_points} points or "
            "more, so that their poses can be refined",
            f"{after.seeing.sum()}; too few in {name_some(names[~after.seeing].tolist())}",
        )
    if before.error - after.error < LIMITS.min_gain:
        return list(given), Refinement(True, before.error, before.error)
    lost = names[strict.seeing & ~after.seeing].tolist()
    if (
        after.seeing.sum() < strict.seeing.sum()
        or after.observations < LIMITS.min_kept * strict.observations
    ):
        raise _refused(
            f"refined poses to fit the {strict.seeing.sum()} images and {strict.observations:,} "
            "observations that the given poses fit",
            f"{after.seeing.sum()} (lost: {name_some(lost) or 'none'}) and {after.observations:,}",
        )
    old = poses_of(given)
    shift, turn, limit = shifts(poses, old), turns(poses, old), LIMITS.max_shift * spread(old)
    drifted = np.flatnonzero((turn > LIMITS.max_turn) | (shift > limit))
    if len(drifted):
        worst = int(drifted[np.argmax(turn[drifted] / LIMITS.max_turn + shift[drifted] / limit)])
        raise _refused(
            f"refinement to rotate no camera by more than {LIMITS.max_turn:g} degrees nor move it "
            f"by more than {limit:.3g} scene units, half of the cameras' spread",
            f"{turn[worst]:.1f} degrees and {shift[worst]:.3g} units in {names[worst]}, and "
            f"{len(drifted)} of {len(names)} such images: {name_some(names[drifted].tolist())}",
        )
    shifted, turned = ((float(np.median(of)), float(of.max())) for of in (shift, turn))
    excluded = tuple(names[~after.seeing].tolist())
    change = Refinement(False, before.error, after.error, *shifted, *turned, excluded)
    return with_poses(given, poses), change


def unrefined_finding(
    total: int, excluded: Sequence[str], unread: Sequence[str] = ()
) -> Finding | None:
    """Return the finding on images, of ``total``, whose poses stay as given beside refined ones.

    ``unread`` have photographs that SfM does not read.
    """
    too_few = f"fewer than {LIMITS.min_points} points are seen in"
    kinds = (("SfM does not read", unread), (too_few, excluded))
    reasons = "; ".join(f"{why} {name_some(names, 3)}" for why, names in kinds if names)
    unrefined = f"The poses of {len(unread) + len(excluded):,} of {counted(total, 'image')}"
    if not reasons:
        return None
    text = f"{unrefined} stay as given: {reasons}."
    return Finding("unrefined-poses", text, subjects=(*unread, *excluded))


def _refused(expected: str, found: str) -> ReconstructionError:
    fix = (
        "Check that the poses belong to these images, in the same order and convention; remove "
        "the images named; or keep the poses with `refine_poses=False`."
    )
    return ReconstructionError(expected, found=found, fix=fix)


class _Fit(NamedTuple):
    seeing: Bool[np.ndarray, " N"]  # photographs with enough points
    observations: int
    error: float  # mean reprojection error over points, px; inf without points


def _enough(seeing: Bool[np.ndarray, " N"]) -> bool:
    """Whether at least half of the photographs have enough points."""
    return bool(2 * seeing.sum() >= len(seeing) and seeing.sum() >= 2)


class _Solver:
    """Rounds of triangulation and bundle adjustment; arguments as for ``refine``."""

    def __init__(self, run: ColmapRun, images: Sequence[Image]) -> None:
        self.rounds = 0
        self._run, self._pycolmap = run, run.pycolmap
        self._images, self._given = images, poses_of(images)
        self._model = posed_model(run.pycolmap, images)
        self._ids = range(1, len(images) + 1)
        lenses = self._model.cameras.values()
        self._focal = float(np.median([lens.mean_focal_length() for lens in lenses]))

    def solve(self) -> tuple[Poses, _Fit, _Fit, _Fit]:
        """Refine until convergence.

        Returns the poses in the given frame, the fit of points triangulated at the given poses, the
        fit at the new poses, and the fit of the latter's observations at the given poses.
        """
        pycolmap, size = self._pycolmap, spread(self._given)
        with pycolmap.Database.open(self._run.database) as database:
            cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(self._model)
        fine = LIMITS.fine
        strict = self._round(mapper, fine[-1], None)
        noise, poses = LIMITS.first_noise * size, self._given
        coarse = [self._focal * math.tan(math.radians(degrees)) for degrees in LIMITS.coarse]
        limits = [*(max(pixels, fine[0]) for pixels in coarse), *fine]
        for pixels in limits + [fine[-1]] * (LIMITS.max_rounds - len(limits)):
            fit = self._round(mapper, pixels, noise)
            if not _enough(fit.seeing):
                break
            old, poses = poses, self._aligned(fit.seeing)
            # Deliberately too large: a tight prior would confirm itself.
            noise = max(float(np.median(shifts(poses, self._given))), LIMITS.min_noise * size)
            noise /= max(fit.error, LIMITS.min_error)  # adjustment assumes 1 px feature noise
            self.rounds += 1
            step = np.radians(turns(poses, old).max()) * self._focal
            if pixels == fine[-1] and step < LIMITS.converged:
                break
        after = self._fit()
        for image_id, image in zip(self._ids, self._images, strict=True):
            self._model.image(image_id).frame.rig_from_world = rigid(pycolmap, image)
        self._adjust(fine[-1], None)
        mapper.observation_manager.filter_observations_with_negative_depth()
        return poses, strict, after, self._fit()

    def _round(self, mapper: Any, pixels: float, noise: float | None) -> _Fit:
        """Triangulate, adjust, and drop observations with errors above ``pixels``."""
        options = self._pycolmap.IncrementalTriangulatorOptions(
            merge_max_reproj_error=pixels,
            complete_max_reproj_error=pixels,
            max_extra_param=math.inf,  # known lenses are trusted
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
        min_angle = self._pycolmap.IncrementalMapperOptions().filter_min_tri_angle
        mapper.observation_manager.filter_all_points3D(pixels, min_angle)
        return self._fit()

    def _adjust(self, pixels: float, noise: float | None) -> None:
        """Adjust points, and also poses if ``noise`` of the given positions is not None."""
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
        options.ceres.solver_options.max_num_iterations = LIMITS.max_iterations
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
        """Return the model's poses in the given frame; given poses for excluded photographs."""
        matrices = [self._model.image(i).cam_from_world().matrix() for i in self._ids]
        found = np.array([matrix[:, :3] for matrix in matrices])
        found_centers = np.array([-matrix[:, :3].T @ matrix[:, 3] for matrix in matrices])
        rotations, centers = self._given.rotations.copy(), self._given.centers.copy()
        rotations[seeing], centers[seeing] = align_poses(
            Poses(found[seeing], found_centers[seeing]), Poses(rotations[seeing], centers[seeing])
        )
        return Poses(rotations, centers)

    def _fit(self) -> _Fit:
        self._model.update_point_3d_errors()
        points = self._model.num_points3D()
        return _Fit(
            np.array([self._model.image(i).num_points3D >= LIMITS.min_points for i in self._ids]),
            self._model.compute_num_observations(),
            float(self._model.compute_mean_reprojection_error()) if points else math.inf,
        )
