"""The examination: photographs, poses, intrinsics and points held against each other, in seconds.

Points that photographs support (``consistency``) confirm poses and intrinsics. Where they do not,
what people's tools do to a capture is tried, in this order: lens distortion and focal lengths, of
which small errors show even where points fit; poses of another convention, by comparing photographs
without the points, which refuses the capture; points in other axes, or of another scale. Points
count as *unfit* only if photographs agree at the poses and see surfaces elsewhere than the points;
nothing is said of what cannot be decided (*unclear*).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from splatseed.checkup.choices import UnfitPoints
from splatseed.checkup.consistency import Evidence, Fit
from splatseed.checkup.distortion import distortion_finding, find_distortion
from splatseed.checkup.focal_lengths import (
    WRONG_FOCAL_LENGTH,
    camera_groups,
    find_focal_factors,
    focal_factor_findings,
)
from splatseed.checkup.hypotheses import Affine, Found, find_axes, find_intrinsics, find_similarity
from splatseed.checkup.poses import WrongConventionError, check_poses, compare_samples
from splatseed.depth.stereo.maps import MIN_POINTS, StereoMap
from splatseed.errors import ParameterError, SceneFormatError, SplatseedError
from splatseed.findings import Finding
from splatseed.photos.visibility import points_in_image
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene

UNFIT_POINTS = "points-do-not-fit"


@dataclass(frozen=True)
class _Settings:
    """When points fit, and when they do not."""

    min_support: float = 0.2
    """Support of points that fit; nine captures have 0.39 and more."""
    min_confirming: int = 30
    """Minimum number of points compared, to confirm the poses."""
    max_color_error: float = 0.45
    """Colour error of points that are not called unfit, whatever their support."""
    max_unfit: float = 0.1
    """Support of points that are unfit; wrong ones reached 0.09."""
    max_unlike: float = 0.55
    """Colour error from which on points may be unfit."""
    unrelated: float = 0.85
    """Colour error of points whose colours say nothing of the photographs; right ones reached
    0.58."""
    max_unrelated: float = 0.3
    """Support of unfit points of such colours: cameras close together confirm a part of any."""
    min_tested: int = 100
    """Minimum number of points compared, to report that photographs agree nowhere."""
    min_surface: int = 100
    """Minimum number of pixels whose depth photographs confirm, to call points unfit."""
    same_depth: float = 0.1
    """Relative difference at which a point's depth is that of the photographs."""
    max_at_surface: float = 0.4
    """Share of unfit points at the depth that photographs see."""


EXAMINATION = _Settings()


@dataclass(frozen=True, eq=False)
class CheckUp:
    """What the examination shows."""

    points: Literal["fit", "unclear", "unfit"]
    fit: Fit | None = None  # None: there was nothing to compare
    scene_from_points: Affine | None = None  # that makes points fit, where they do not
    findings: tuple[Finding, ...] = ()

    @property
    def confirms_poses(self) -> bool:
        """Whether the points confirm the poses."""
        return self.points == "fit"


UNCLEAR = CheckUp("unclear")


def examine(
    scene: Scene,
    images: Sequence[Image],
    progress: Progress = silent,
    evidence: Evidence | None = None,
) -> CheckUp:
    """Hold the points of a scene against photographs and poses.

    Args:
        scene: A scene; without points or photographs, nothing is found.
        images: Those of its images that may be compared.
        progress: Called with the stage and the fraction done.
        evidence: That of these images, which keeps the photographs that it has read.

    Raises:
        SceneFormatError: The poses are of another convention: the same error as without points.
    """
    originals = scene.points.originals
    if len(images) < 2 or np.count_nonzero(originals.distinct) < MIN_POINTS:
        return UNCLEAR
    try:
        return _examine(scene, images, progress, evidence or Evidence(scene, images))
    except WrongConventionError:
        raise
    except SplatseedError:  # photographs that cannot be used, which the reader of them reports
        return UNCLEAR
    finally:
        progress("check points", 1.0)


def _examine(
    scene: Scene, images: Sequence[Image], progress: Progress, evidence: Evidence
) -> CheckUp:
    progress("check points", 0.0)
    fit = evidence.fit(evidence.given)
    enough = fit.tested >= EXAMINATION.min_confirming
    unrelated = fit.color_error >= EXAMINATION.unrelated
    needed = EXAMINATION.max_unrelated if unrelated else EXAMINATION.min_support
    fits = fit.support >= needed and enough
    if fit.tested and (findings := _camera_findings(evidence, fit, fits=fits)):
        return CheckUp("fit" if fits else "unclear", fit, findings=findings)
    if fits:
        return CheckUp("fit", fit)
    progress("check points", 0.3)
    try:
        check_poses(scene, images, progress)
    except WrongConventionError:
        raise
    except SceneFormatError as refused:
        return CheckUp("unclear", fit, findings=_disagreement(fit, refused))
    most = EXAMINATION.max_unrelated if unrelated else EXAMINATION.max_unfit
    if fit.support > most or fit.color_error < EXAMINATION.max_color_error:
        return CheckUp("unclear", fit)
    progress("check points", 0.6)
    return _examine_frame(evidence, images, fit)


def _camera_findings(evidence: Evidence, fit: Fit, *, fits: bool) -> tuple[Finding, ...]:
    """Find lens distortion or focal lengths that fit the photographs better than the given."""
    images, groups = evidence.images, camera_groups(evidence.images)
    better: list[tuple[float, tuple[Finding, ...]]] = []
    if distortion := find_distortion(evidence, fit, groups):
        finding = distortion_finding(evidence.scene, images, groups, distortion)
        better.append((distortion.fit.support, (finding,)))
    start, there = evidence.given, fit
    if found := find_intrinsics(evidence, fit, nearby=fits):
        start, there = found.hypothesis, found.fit
        better.append((there.support, (_focal_finding(images, fit, found),)))
    scaled = start.center_factor != 1.0 or (found and not max(groups))
    if not scaled and (factors := find_focal_factors(evidence, there, start, groups)):
        named = focal_factor_findings(images, groups, factors)
        better.append((factors.after.support, named))
    return max(better, key=lambda each: each[0])[1] if better else ()


def _examine_frame(evidence: Evidence, images: Sequence[Image], fit: Fit) -> CheckUp:
    """Find the frame of points that do not fit, at poses that do."""
    if found := find_axes(evidence, fit):
        return _moved(fit, found)
    compared = compare_samples(evidence.scene, images)
    maps = [each for stereo, _ in compared for each in stereo.maps()]
    surfaces = PointCloud.concatenate(*[each.points() for each in maps])
    if found := find_similarity(evidence, fit, surfaces):
        return _moved(fit, found)
    if (
        len(surfaces) < EXAMINATION.min_surface
        or _share_at_surface(maps, evidence) > EXAMINATION.max_at_surface
        or fit.color_error < EXAMINATION.max_unlike
    ):
        return CheckUp("unclear", fit)
    text = (
        f"Photographs confirm {fit.confirmed:.0%} of the points where they are, {fit.chance:.0%} "
        "by chance, and see surfaces elsewhere: the points are random, or of another scene or "
        "frame."
    )
    return CheckUp("unfit", fit, findings=(_unfit_finding(text),))


def _disagreement(fit: Fit, refused: SceneFormatError) -> tuple[Finding, ...]:
    """Report that photographs agree nowhere, if the points do not fit them either."""
    if fit.tested < EXAMINATION.min_tested or fit.color_error < EXAMINATION.max_unlike:
        return ()
    text = f"The photographs cannot be compared: {refused}"
    return (Finding("photographs-disagree", text, "error"),)


def _moved(fit: Fit, found: Found) -> CheckUp:
    assert found.affine is not None  # noqa: S101  (the search was for one)
    text = (
        f"The points are in another frame than the poses: photographs confirm {fit.confirmed:.0%} "
        f"of them where they are, and {found.fit.confirmed:.0%} {describe_affine(found.affine)}."
    )
    move = "; `unfit_points='move'` moves them."
    return CheckUp("unfit", fit, found.affine, (_unfit_finding(text, move),))


def _unfit_finding(text: str, other: str = "; `unfit_points='keep'` keeps them.") -> Finding:
    return Finding(UNFIT_POINTS, text, "error", fix=f"Seeds and training do without them{other}")


def _focal_finding(images: Sequence[Image], fit: Fit, found: Found) -> Finding:
    given = images[0].intrinsics
    factor, center = found.hypothesis.focal_factor, found.hypothesis.center_factor
    what, right = "focal lengths", f"{factor * given.K[0, 0]:.5g}"
    if center != 1.0:
        what = "focal lengths and principal points"
    others = "" if len({image.intrinsics.camera_id for image in images}) == 1 else " of the first"
    text = (
        f"The {what} are not those of the photographs: photographs confirm {fit.confirmed:.0%} of "
        f"the points, and {found.fit.confirmed:.0%} with {what} {factor:.3g} times as large."
    )
    fix = (
        f"Set the focal length{others} to about {right} px, for {given.width} x {given.height} "
        "pixels"
    )
    if center != 1.0:
        fix += f", the principal point to {given.K[0, 2] * center:.5g}, "
        fix += f"{given.K[1, 2] * center:.5g}"
    return Finding(WRONG_FOCAL_LENGTH, text, "error", fix=f"{fix}.")


def describe_affine(affine: Affine) -> str:
    """Say what a map from the points' frame does, as a clause that begins with a preposition."""
    scale = float(np.cbrt(abs(np.linalg.det(affine[:, :3]))))
    axes = np.rint(affine[:, :3] / scale).astype(int)
    names = [f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in axes]
    parts = []
    if names != ["x", "y", "z"]:
        parts.append(f"x, y, z are {', '.join(names)}")
    if abs(scale - 1) > 0.005:
        parts.append(f"they are scaled by {scale:.3g}")
    if np.abs(affine[:, 3]).max() > 0:
        parts.append(f"shifted by {', '.join(f'{t:.3g}' for t in affine[:, 3])}")
    return f"once {' and '.join(parts)}"


def _share_at_surface(maps: Sequence[StereoMap], evidence: Evidence) -> float:
    """Share of the points at the depth that photographs see, of those in front of such pixels."""
    near = total = 0
    for each in maps:
        points = points_in_image(each.camera, evidence.given.xyz)
        shape = each.depth.shape
        nearest, seen = points.nearest(each.camera, shape), each.depth
        known = np.isfinite(nearest) & np.isfinite(seen)
        ratio = nearest[known] / seen[known]
        near += int(np.count_nonzero(np.abs(ratio - 1) <= EXAMINATION.same_depth))
        total += len(ratio)
    return near / total if total else 0.0


def comparable(scene: Scene, test_every: int = 0) -> tuple[Image, ...]:
    """The images whose photographs may be compared, by name: not test views.

    With ``test_every`` 0, test views are those that the scene lists.
    """
    return tuple(image for image in scene.split(test_every)[0] if image.has_photograph)


def with_fitting_points(
    scene: Scene,
    unfit_points: UnfitPoints = "drop",
    progress: Progress = silent,
    *,
    test_every: int = 0,
) -> tuple[Scene, tuple[Finding, ...]]:
    """Examine a scene, and leave out, move or keep points that do not fit; also return findings.

    ``test_every`` leaves out every n-th photograph by name; 0: those that the scene lists as tests.

    Raises:
        ParameterError: ``unfit_points`` is none of these.
        SceneFormatError: The poses are of another convention.
    """
    if unfit_points not in get_args(UnfitPoints):
        choices = ", ".join(get_args(UnfitPoints))
        raise ParameterError(
            f"`unfit_points` as one of {choices}",
            found=repr(unfit_points),
            fix="Try drop, the default.",
        )
    return fitting(scene, examine(scene, comparable(scene, test_every), progress), unfit_points)


def fitting(
    scene: Scene, checkup: CheckUp, unfit_points: UnfitPoints
) -> tuple[Scene, tuple[Finding, ...]]:
    """Leave out, move or keep points that do not fit by an examination; also return findings."""
    if checkup.points != "unfit" or unfit_points == "keep":
        return scene, checkup.findings
    if unfit_points == "move" and (affine := checkup.scene_from_points) is not None:
        moved = scene.points.originals
        xyz = moved.xyz.astype(np.float64) @ affine[:, :3].T + affine[:, 3]
        points = moved.replace(xyz=xyz.astype(np.float32), normals=None)
        text = (
            f"{len(points):,} points were moved: {describe_affine(affine).removeprefix('once ')}."
        )
        return scene.with_points(points), (Finding("transformed-points", text, "info"),)
    points = scene.points
    return scene.with_points(points.select(points.source < 0)), checkup.findings
