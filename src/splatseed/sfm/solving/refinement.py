"""Refinement of poses that a device gave: off by centimetres and a degree or two.

Points are triangulated at the given poses, and bundle adjustment moves poses and points together;
what may count as an observation shrinks from round to round. Matches were verified pair by pair
without the poses, so they are right however far off the poses are. Lenses stay as they are given.
Given positions are priors whose noise is estimated from what remains: it holds the cameras that
few matches hold. Last, all poses are brought back to the given ones' frame and scale.

Notation: ``model`` is pycolmap's Reconstruction; px are pixels of the photographs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool

from splatseed.errors import ReconstructionError
from splatseed.scene import Image
from splatseed.sfm.features import Run
from splatseed.sfm.photos import name_some
from splatseed.sfm.report import Refinement
from splatseed.sfm.solving.mapping import posed_model, rigid
from splatseed.sfm.solving.poses import Poses, align, poses_of, shifts, spread, turns, with_poses

COARSE = (6.0, 2.0)
"""Degrees by which an observation may miss its point in the first rounds."""
FINE = (8.0, 4.0)
"""The same in px in the rounds after; the last, COLMAP's own, is repeated."""
MAX_ROUNDS = 12
MAX_ITERATIONS = 30
"""Of bundle adjustment in a round; the next goes on from there."""
STILL = 0.1
"""Poses are at rest when a round turns every camera by less than this, in px of its image."""
FIRST_NOISE = 0.03
"""Standard deviation of given positions that is assumed first, of the cameras' spread."""
LEAST_NOISE = 1e-4
"""The smallest that is believed."""
LEAST_ERROR = 0.05
"""The smallest reprojection error that is believed, px."""
GAIN = 0.1
"""Given poses are kept when refinement lowers the mean reprojection error by less, in px."""
LEAST_POINTS = 10
"""A photograph that sees fewer points takes no part: they pin its pose down too loosely."""
LEAST_KEPT = 0.95
"""Observations that refined poses fit, of those that fit before: a few wrong ones always go."""
MAX_TURN = 10.0
"""A camera that turned by more, in degrees, has drifted: devices err by a degree or two."""
MAX_SHIFT = 0.5
"""Likewise one that moved by more, of the cameras' spread."""

FIX = (
    "Check that the poses belong to these images, in the same order and convention; take out the "
    "images named; or leave refine_poses out, which keeps the poses."
)
"""What to do about poses that cannot be refined."""


@dataclass(frozen=True)
class _Fit:
    """How photographs and points agree.

    Args:
        seeing: Which photographs see enough points to take part, bool [N].
        observations: How many observations there are.
        error: Mean over the points of their mean reprojection error, px; infinite without points.
    """

    seeing: Bool[np.ndarray, " N"]
    observations: int
    error: float


@dataclass(frozen=True)
class _Solution:
    """What the rounds came to.

    Args:
        poses: In the given frame.
        strict: The fit of what can be triangulated at the given poses.
        after: The fit at ``poses``.
        before: The fit of the same observations at the given poses.
    """

    poses: Poses
    strict: _Fit
    after: _Fit
    before: _Fit


def refine(
    run: Run, cameras: Sequence[Any], images: Sequence[Any], given: Sequence[Image]
) -> tuple[list[Image], Refinement]:
    """Move the given poses to where the photographs' matches agree.

    Cameras that see fewer than 10 points stay where they are. Where the mean reprojection error
    would fall by less than 0.1 px, all stay exactly where they are.

    Args:
        run: The run, with verified matches.
        cameras: The cameras of the database.
        images: The images of the database.
        given: Their poses, in the same order.

    Returns:
        The images with their new poses, and what changed.

    Raises:
        ReconstructionError: Fewer than half of the photographs see points, or the poses drifted:
            fewer photographs or observations fit than before, a camera turned by more than 10
            degrees or moved by more than half of the cameras' root mean square distance from their
            middle.
    """
    solver = _Solver(run, cameras, images, given)
    solution = run.stages.run("refinement", solver.solve, lambda: solver.rounds, MAX_ROUNDS)
    names = [image.name for image in given]
    _check_seeing(solution, names)
    before, after = solution.before.error, solution.after.error
    if before - after < GAIN:
        return list(given), Refinement(True, before, before, 0.0, 0.0, 0.0, 0.0)
    old = poses_of(given)
    _check_drift(solution, old, names)
    shift, turn = shifts(solution.poses, old), turns(solution.poses, old)
    return with_poses(given, solution.poses), Refinement(
        kept=False,
        error_before=before,
        error_after=after,
        median_shift=float(np.median(shift)),
        largest_shift=float(shift.max()),
        median_turn=float(np.median(turn)),
        largest_turn=float(turn.max()),
    )


def _enough(seeing: Bool[np.ndarray, " N"]) -> bool:
    """Whether half of the photographs take part."""
    return bool(2 * seeing.sum() >= len(seeing) and seeing.sum() >= 2)


def _check_seeing(solution: _Solution, names: Sequence[str]) -> None:
    """Refuse a refinement in which fewer than half of the photographs take part."""
    seeing = solution.after.seeing
    if _enough(seeing):
        return
    blind = [name for name, sees in zip(names, seeing, strict=True) if not sees]
    raise ReconstructionError(
        f"at least half of the {len(names)} posed images to see {LEAST_POINTS} points or more, so "
        "that their poses can be refined",
        found=f"{seeing.sum()}; too few in {name_some(blind)}",
        fix=FIX,
    )


def _check_drift(solution: _Solution, given: Poses, names: Sequence[str]) -> None:
    """Refuse poses that have drifted."""
    strict, after = solution.strict, solution.after
    lost = [name for name, gone in zip(names, strict.seeing & ~after.seeing, strict=True) if gone]
    if after.seeing.sum() < strict.seeing.sum():
        raise ReconstructionError(
            f"refined poses to fit the {strict.seeing.sum()} images that the given poses fit",
            found=f"{after.seeing.sum()}, without {name_some(lost)}",
            fix=FIX,
        )
    if after.observations < LEAST_KEPT * strict.observations:
        raise ReconstructionError(
            f"refined poses to fit the {strict.observations:,} observations that the given fit",
            found=f"{after.observations:,}",
            fix=FIX,
        )
    turn, shift = turns(solution.poses, given), shifts(solution.poses, given)
    limit = MAX_SHIFT * spread(given)
    drifted = np.flatnonzero((turn > MAX_TURN) | (shift > limit))
    if len(drifted):
        worst = int(drifted[np.argmax(turn[drifted] / MAX_TURN + shift[drifted] / limit)])
        raise ReconstructionError(
            f"refinement to turn no camera by more than {MAX_TURN:g} degrees nor move it by more "
            f"than {limit:.3g} scene units, half of the cameras' spread",
            found=f"{turn[worst]:.1f} degrees and {shift[worst]:.3g} units in {names[worst]}, and "
            f"{len(drifted)} of {len(names)} such images: "
            f"{name_some([names[i] for i in drifted.tolist()])}",
            fix=FIX,
        )


class _Solver:
    """Rounds of triangulation and bundle adjustment.

    Args:
        run: The run.
        cameras: The cameras of the database.
        images: The images of the database.
        given: Their poses, in the same order.
    """

    def __init__(
        self, run: Run, cameras: Sequence[Any], images: Sequence[Any], given: Sequence[Image]
    ) -> None:
        self.rounds = 0
        self._run = run
        self._pycolmap = run.pycolmap
        self._ids = [image.image_id for image in images]
        self._given = poses_of(given)
        self._images = given
        self._focal = float(np.median([camera.mean_focal_length() for camera in cameras]))
        self._model = posed_model(self._pycolmap, cameras, images, given)

    def solve(self) -> _Solution:
        """Refine until the poses rest."""
        pycolmap = self._pycolmap
        with pycolmap.Database.open(self._run.database) as database:
            cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions())
        mapper = pycolmap.IncrementalMapper(cache)
        mapper.begin_reconstruction(self._model)
        strict = self._fit_at_given(mapper)
        noise, poses = FIRST_NOISE * spread(self._given), self._given
        for pixels in self._limits():
            self._triangulate(mapper, pixels)
            self._adjust(pixels, noise)
            self._filter(mapper, pixels)
            fit = self._fit()
            if not _enough(fit.seeing):
                break
            old, poses = poses, self._aligned()
            least = LEAST_NOISE * spread(self._given)
            # A little too large on purpose: a prior too tight would prove itself right
            noise = max(float(np.median(shifts(poses, self._given))), least)
            noise /= max(fit.error, LEAST_ERROR)  # adjustment takes features' noise for 1 px
            self.rounds += 1
            if pixels == FINE[-1] and np.radians(turns(poses, old).max()) * self._focal < STILL:
                break
        after = self._fit()
        self._restore()
        self._adjust(FINE[-1], None)
        mapper.observation_manager.filter_observations_with_negative_depth()
        return _Solution(poses, strict, after, self._fit())

    def _limits(self) -> list[float]:
        """How far an observation may miss its point in each round, px."""
        coarse = [self._focal * math.tan(math.radians(degrees)) for degrees in COARSE]
        limits = [max(pixels, FINE[0]) for pixels in coarse] + list(FINE)
        return limits + [FINE[-1]] * (MAX_ROUNDS - len(limits))

    def _fit_at_given(self, mapper: Any) -> _Fit:
        self._triangulate(mapper, FINE[-1])
        self._adjust(FINE[-1], None)
        self._filter(mapper, FINE[-1])
        return self._fit()

    def _triangulate(self, mapper: Any, pixels: float) -> None:
        options = self._pycolmap.IncrementalTriangulatorOptions()
        degrees = math.degrees(math.atan(pixels / self._focal))
        for name in ("create_max_angle_error", "continue_max_angle_error", "re_max_angle_error"):
            setattr(options, name, max(degrees, getattr(options, name)))
        options.merge_max_reproj_error = options.complete_max_reproj_error = pixels
        options.max_extra_param = math.inf  # a known lens is trusted
        options.random_seed = self._run.settings.seed
        for image_id in self._ids:
            mapper.triangulate_image(options, image_id)
        mapper.complete_and_merge_tracks(options)
        mapper.retriangulate(options)

    def _filter(self, mapper: Any, pixels: float) -> None:
        least = self._pycolmap.IncrementalMapperOptions().filter_min_tri_angle
        mapper.observation_manager.filter_all_points3D(pixels, least)

    def _adjust(self, pixels: float, noise: float | None) -> None:
        """Adjust points, and poses too if the ``noise`` of given positions is told."""
        if self._model.num_points3D() == 0:
            return
        pycolmap = self._pycolmap
        options = pycolmap.BundleAdjustmentOptions()
        options.refine_focal_length = options.refine_extra_params = False
        options.refine_sensor_from_rig = options.print_summary = False
        options.refine_rig_from_world = noise is not None
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = pixels / 4
        options.ceres.solver_options.function_tolerance = 1e-6
        options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
        options.ceres.solver_options.num_threads = self._run.settings.threads
        config = pycolmap.BundleAdjustmentConfig()
        for image_id in self._ids:
            config.add_image(image_id)
        for camera_id in self._model.cameras:
            config.set_constant_cam_intrinsics(camera_id)
        if noise is None:
            pycolmap.create_default_bundle_adjuster(options, config, self._model).solve()
            return
        of_priors = pycolmap.PosePriorBundleAdjustmentOptions()
        of_priors.ceres.prior_position_loss_function_type = pycolmap.LossFunctionType.CAUCHY
        of_priors.alignment_ransac.random_seed = self._run.settings.seed
        priors = [self._prior(*each, noise) for each in enumerate(self._ids)]
        pycolmap.create_pose_prior_bundle_adjuster(
            options, of_priors, config, priors, self._model
        ).solve()

    def _prior(self, index: int, image_id: int, noise: float) -> Any:
        prior = self._pycolmap.PosePrior(pose_prior_id=image_id)
        prior.corr_data_id = self._model.image(image_id).data_id
        prior.position = self._given.centers[index]
        prior.position_covariance = noise**2 * np.eye(3)
        prior.coordinate_system = self._pycolmap.PosePriorCoordinateSystem.CARTESIAN
        return prior

    def _aligned(self) -> Poses:
        """The model's poses in the given frame; given ones where a photograph sees no point."""
        matrices = [self._model.image(i).cam_from_world().matrix() for i in self._ids]
        rotations = np.array([matrix[:, :3] for matrix in matrices])
        centers = np.array([-matrix[:, :3].T @ matrix[:, 3] for matrix in matrices])
        found, seeing = Poses(rotations, centers), self._fit().seeing
        aligned = align(found.only(seeing), self._given.only(seeing))
        return self._given.with_new(seeing, aligned)

    def _restore(self) -> None:
        """Put the given poses back."""
        for image_id, image in zip(self._ids, self._images, strict=True):
            self._model.image(image_id).frame.rig_from_world = rigid(self._pycolmap, image)

    def _fit(self) -> _Fit:
        self._model.update_point_3d_errors()
        points = self._model.num_points3D()
        return _Fit(
            np.array([self._model.image(i).num_points3D >= LEAST_POINTS for i in self._ids]),
            self._model.compute_num_observations(),
            float(self._model.compute_mean_reprojection_error()) if points else math.inf,
        )
