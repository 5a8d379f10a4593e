"""What ``splatseed info`` finds out by comparing photographs, and its verdict in one line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from splatseed.console import with_options
from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.seeding.photo_methods import has_points, photographed

if TYPE_CHECKING:  # Numba, which takes a while to load, comes with it
    from splatseed.checkup.examination import CheckUp
    from splatseed.checkup.pose_accuracy import PoseErrorEstimate


@dataclass(frozen=True)
class PoseCheck:
    """What comparing a few photographs shows about the poses."""

    agreement: float  # fraction of the compared pixels whose depth other photographs confirm
    error: PoseErrorEstimate | None
    doubts: tuple[Finding, ...] = ()  # why the poses may be wrong
    faint: tuple[Finding, ...] = ()  # that photographs agree at few pixels

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All that it shows."""
        return (*self.doubts, *self.faint)

    @property
    def inexact(self) -> bool:
        """Whether refinement may correct the poses."""
        from splatseed.checkup.pose_accuracy import INEXACT_POSES

        return any(each.kind == INEXACT_POSES for each in self.doubts)

    @property
    def wrong(self) -> bool:
        """Whether nothing can be made at these poses."""
        return any(each.severity == "error" for each in self.doubts)

    @property
    def facts(self) -> dict[str, Any]:
        """What ``--json`` prints."""
        problem = with_options("".join(map(str, self.doubts)))
        return {"agreement": self.agreement, "error": self.error, "problem": problem}


@dataclass(frozen=True)
class CaptureCheck:
    """What comparing photographs with points and with each other shows."""

    points: CheckUp | None  # None where photographs or points are missing, or poses are refused
    poses: PoseCheck | None  # None without photographs, or where points confirm the poses
    single: tuple[Finding, ...]  # photographs whose poses are wrong

    @property
    def findings(self) -> tuple[Finding, ...]:
        """All that it shows."""
        points = self.points.findings if self.points else ()
        return (*points, *self.single, *(self.poses.findings if self.poses else ()))

    @property
    def unfit_points(self) -> bool:
        """Whether photographs contradict the points."""
        return self.points is not None and self.points.points == "unfit"

    @property
    def first(self) -> str:
        """What must be mended first, as an imperative; empty if there is nothing."""
        kinds = {each.kind for each in self.findings}
        if "wrong-focal-length" in kinds:
            return "correct the focal length first, as the line at the top says"
        if "wrong-distortion" in kinds:
            return "correct the lens distortion first, as the line at the top says"
        if self.poses is not None and self.poses.wrong:
            return "correct the poses first, as the line at the top says"
        return ""

    @property
    def facts(self) -> dict[str, Any]:
        """What ``--json`` prints of the points."""
        if self.points is None:
            return {"points": "unclear"}
        fit, affine = self.points.fit, self.points.scene_from_points
        facts: dict[str, Any] = {"points": self.points.points}
        if fit is not None and fit.tested:
            facts |= {"tested": fit.tested, "confirmed": fit.confirmed, "by_chance": fit.chance}
            facts |= {"color_error": fit.color_error}
        if affine is not None:
            facts["scene_from_points"] = affine.tolist()
        return facts

    @property
    def rows(self) -> list[tuple[str, str]]:
        """How many points photographs confirm, for the table."""
        fit = self.points.fit if self.points else None
        if fit is None or not fit.tested:
            return []
        shares = f"{fit.confirmed:.0%} of those compared, {fit.chance:.0%} by chance"
        return [("photographs confirm points", shares)]

    def verdict(self, scene: Scene, problems: Sequence[Finding]) -> str:
        """Say in one line whether the parts of a capture fit each other, or what does not."""
        doubts = [*problems, *(self.poses.doubts if self.poses else ())]
        if wrong := next((each for each in doubts if each.severity == "error"), None):
            return f"Does not fit: {wrong}"
        if self.poses is not None and self.poses.doubts:
            return f"Fits roughly: {self.poses.doubts[0]}"
        if not scene.has_photographs:
            return "There are no photographs to check the rest against."
        if self.points is not None and self.points.confirms_poses and self.points.fit is not None:
            share = self.points.fit.confirmed
            return f"Fits: photographs confirm {share:.0%} of the points compared."
        if self.poses is not None and not self.poses.faint:
            agreement = self.poses.agreement
            return f"Fits: photographs agree at {agreement:.0%} of the pixels compared."
        return "Unclear: photographs agree at too few places to say whether the poses are right."


def check_capture(
    scene: Scene, masked: float, progress: Progress, *, all_photographs: bool = False
) -> CaptureCheck:
    """Compare photographs with points, and a few with each other.

    Args:
        scene: The scene.
        masked: Share of the pixels that masks exclude.
        progress: Called with the stage and the fraction done.
        all_photographs: Compare all with the points, to find single wrong poses.
    """
    if not scene.has_photographs:
        return CaptureCheck(None, None, ())
    from splatseed.checkup.consistency import Evidence
    from splatseed.checkup.examination import comparable, examine
    from splatseed.checkup.wrong_poses import SAMPLE, find_wrong_poses

    points, refused, single = None, None, tuple[Finding, ...]()
    images = comparable(scene)
    evidence = Evidence(scene, images) if len(images) > 1 else None
    try:
        points = examine(scene, images, progress, evidence)
    except SplatseedError as error:
        refused = error
    if points is not None and points.confirms_poses and not points.findings:
        limit = None if all_photographs else SAMPLE
        single = find_wrong_poses(scene, images, progress, limit, evidence)
    return CaptureCheck(points, _check_poses(scene, masked, refused, progress), single)


def _check_poses(
    scene: Scene, masked: float, refused: SplatseedError | None, progress: Progress
) -> PoseCheck | None:
    """Compare a few photographs of a scene with each other.

    ``refused`` is why the examination of points refuses the poses. Else a scene with points has no
    doubts: it can be trained from them.
    """
    from splatseed.checkup.focal_by_pairs import find_focal_length
    from splatseed.checkup.pose_accuracy import INEXACT_POSES, estimate_pose_error, given_pose_error
    from splatseed.checkup.poses import (
        InexactPosesError,
        WrongConventionError,
        agreement_findings,
        check_poses,
    )

    try:
        if refused is not None:
            raise refused
        images = photographed(scene)
        agreement = check_poses(scene, images, progress)
    except SplatseedError as error:
        if has_points(scene) and not isinstance(error, WrongConventionError):
            return None
        kind = INEXACT_POSES if isinstance(error, InexactPosesError) else "photographs-disagree"
        text = f"The photographs cannot be compared: {error}"
        return PoseCheck(0.0, None, (Finding(kind, text, "error"),))
    if has_points(scene):
        return PoseCheck(agreement, estimate_pose_error(scene, images, progress))
    pose_error = given_pose_error(scene, images, progress)
    doubts = find_focal_length(scene, images, pose_error, progress)
    doubts = doubts or (pose_error.findings if pose_error else ())
    return PoseCheck(agreement, pose_error, doubts, agreement_findings(agreement, masked))
