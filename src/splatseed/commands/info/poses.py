"""What ``splatseed info`` says of poses for which no points vouch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from splatseed.errors import SplatseedError
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.seeding.photographs import has_points, photographed

if TYPE_CHECKING:  # kernels load with its use
    from splatseed.seeding.poses import PoseError

REFINE = "--refine-poses"
"""What problems that it can mend name."""


@dataclass(frozen=True)
class Poses:
    """What the photographs tell of their poses.

    Args:
        agreement: Share of the pixels looked at whose depth others confirm.
        error: By how much the photographs miss each other; None if that could not be told.
        problem: Why they cannot be compared, or should not be as they are; empty if they can.
    """

    agreement: float
    error: PoseError | None
    problem: str

    @property
    def refine(self) -> bool:
        """Whether they should be refined first."""
        return REFINE in self.problem

    @property
    def usable(self) -> bool:
        """Whether depth can be found at these poses, refined where that is advised."""
        return self.refine or not self.problem

    def rows(self) -> list[tuple[str, str]]:
        """The facts as rows of the table."""
        if self.error is None and self.problem:
            return []
        miss = "cannot be told" if self.error is None else f"{self.error}"
        return [
            ("photographs agree", f"at {self.agreement:.0%} of the pixels looked at"),
            ("they miss by", miss),
        ]


def look_at_poses(scene: Scene, progress: Progress) -> Poses | None:
    """Compare a few photographs of a scene without points; None with points or without any."""
    if has_points(scene) or not scene.has_photographs:
        return None
    from splatseed.seeding.poses import check_poses, pose_error  # noqa: PLC0415  (loads Numba)

    try:
        images = photographed(scene)
        agreement = check_poses(scene, images, progress)
    except SplatseedError as refused:
        return Poses(0.0, None, f"The photographs cannot be compared: {refused}")
    error = pose_error(scene, images, progress)
    return Poses(agreement, error, error.warning if error else "")
