"""The method ``cloud``: seeds from scans and dense clouds, as many as the photographs resolve.

Points stream into voxels; those stay that a photograph sees and nothing contradicts (``judging``).
A cloud that is nowhere near the cameras, or does not fit the scene's own points, is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from jaxtyping import Float64

from splatseed.depth.stereo.maps import StereoSettings
from splatseed.errors import ParameterError, PointCloudError
from splatseed.io.origin import ELSEWHERE
from splatseed.methods import source_code
from splatseed.methods.contract import NewPoints, Traits
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.seeding.photo_methods import MAX_SIZE, compare, photographed, read_views
from splatseed.seeding.upsampling import CELL, frames_of
from splatseed.settings import Range, check_settings
from splatseed.similarity import Similarity

if TYPE_CHECKING:
    from splatseed.photos.view import View
    from splatseed.seeding.clouds.judging import Judged, Surface
    from splatseed.seeding.clouds.voxels import MemoryPlan, Streamed

FITS = 0.2
"""Below this share of the scene's own points at the cloud's depth it is another's: a cloud of
another place has 0 to 0.1, one in the right place 0.36 (red kitchen, noisy) to 0.92 (room0)."""
DOUBTFUL = 0.55
ENOUGH = 50  # points of the scene below which the share says nothing
UNKNOWN = 0.5  # confidence of a point that fewer than two photographs see
CORNER = 0.5  # below this share of the photographs' cells, a note says how little the cloud covers
GRID = 1e5  # coordinates from here on, in metres, are those of a national grid


@dataclass(frozen=True)
class Cloud:
    """Seeds from scans and dense clouds (--cloud), as many as the photographs resolve."""

    pixels: Annotated[float, Range(0.25, 64)] = 2.0
    """Side of the voxels that merge points, in pixels of the photograph that is closest."""
    recolor: bool = False
    """Take colours from the photographs even if the cloud has some."""
    clean: bool = True
    """Leave out points that the photographs contradict, and points that float alone."""
    test_every: Annotated[int, Range(2, also=0)] = 0
    """Leave out every n-th image by name, as trainers do for testing (8); 0 = use all."""

    name: ClassVar[str] = "cloud"
    traits: ClassVar[Traits] = Traits(frozenset({"cloud"}), chooses_number=True)

    def __post_init__(self) -> None:
        check_settings(self, self.name)

    def of(
        self, *files: Path | str, transform: Similarity | None = None, memory: int | None = None
    ) -> GivenClouds:
        """The method for some files in one frame, with the transform from there to the scene's.

        Voxels grow where they do not fit into ``memory`` bytes, by default 4 GB.
        """
        paths = tuple(map(str, files))
        return GivenClouds(**vars(self), files=paths, transform=transform, memory=memory)

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Ask for a cloud: ``of`` names it."""
        raise ParameterError(
            "--cloud FILE for the method cloud", found="none", fix="Name the scan."
        )


@dataclass(frozen=True)
class GivenClouds(Cloud):
    """The method for some files; ``Cloud.of`` makes it."""

    files: tuple[str, ...] = ()
    transform: Similarity | None = None  # from their frame to the scene's
    memory: int | None = None  # most bytes
    alone: bool = True  # whether no other method adds what the clouds lack: notes then name one

    def plan(self, scene: Scene) -> MemoryPlan:
        """What it will take for a scene.

        Raises:
            ParameterError: The scene has no cameras, or the memory is not enough.
        """
        from splatseed.seeding.clouds.voxels import plan_memory  # noqa: PLC0415  (loads Numba)

        if not scene.images:
            raise ParameterError(
                "a scene with cameras, which choose among the points of a cloud",
                found="none",
                fix="Name the scene of the photographs; for a cloud alone: --method mls or linear.",
            )
        return plan_memory(self.memory, frames_of(scene))

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Seeds from the clouds."""
        from splatseed.photos.visibility import find_visibility  # noqa: PLC0415  (loads with its use)
        from splatseed.seeding.clouds.judging import judge  # noqa: PLC0415  (loads Numba)
        from splatseed.seeding.clouds.voxels import stream  # noqa: PLC0415  (loads Numba)
        from splatseed.seeding.coverage import covered_share  # noqa: PLC0415  (loads Numba)

        capacity, frames = self.plan(scene).capacity, frames_of(scene)
        paths = [Path(each) for each in self.files]
        streamed = stream(paths, self.transform, frames, self.pixels, capacity, progress)
        voxels, images, views = streamed.voxels, scene.images, frames
        if not len(voxels) or _is_elsewhere(streamed, scene):
            raise _out_of_view(streamed, scene)
        if scene.has_photographs:
            images = photographed(scene, self.test_every)
            views = read_views(scene, images, MAX_SIZE, progress)
        visibility = find_visibility(scene)
        nothing = np.empty((0, 3))
        seen = [visibility.of(image) if len(visibility.xyz) else nothing for image in images]
        colored = all(file.colors == "rgb" for file in streamed.files)
        own = voxels.rgb if all(file.colors != "none" for file in streamed.files) else None
        rays = _free_rays(scene, images, views, seen, rng, progress) if self.clean else None
        judged = judge(
            views, seen, voxels, own if colored else None, progress, clean=self.clean, rays=rays
        )
        xyz, evidence = voxels.xyz[judged.kept], judged.evidence
        pictured = scene.has_photographs and (self.recolor or not colored)
        rgb = evidence.rgb if own is None or pictured else own[judged.kept]
        gone = [f"{judged.hidden:,} are hidden in every photograph"]
        gone += [f"{count:,} {reason}" for reason, count in judged.reasons.items() if count]
        kept = f"Kept {len(judged.kept):,} of {len(voxels):,} merged points: {', '.join(gone)}."
        notes = [*_read_notes(streamed), *_check_fit(judged), kept]
        if scene.has_photographs and not colored:
            known = any(file.colors != "none" for file in streamed.files)
            lacks = "intensity only" if own is not None else "colours in some files only"
            lacks = lacks if known else "no colours"
            notes.append(f"The cloud has {lacks}: colours are those of the photographs.")
        share = covered_share(frames, xyz, CELL, silent)
        if share < CORNER:
            hint = ": --method auto with --cloud seeds the rest" if self.alone else ""
            notes.append(f"The cloud covers {share:.0%} of the photographs{hint}.")
        return NewPoints(
            xyz, rgb, tuple(notes),
            confidence=np.nan_to_num(evidence.agreement, nan=UNKNOWN),
            source=np.full(len(xyz), source_code("cloud"), np.uint8),
        )  # fmt: skip


def _free_rays(
    scene: Scene,
    images: Sequence[Image],
    views: Sequence[View],
    seen: Sequence[Float64[np.ndarray, "M 3"]],
    rng: np.random.Generator,
    progress: Progress,
) -> Sequence[Surface] | None:
    """Where rays are known to be free: up to tracked points, and up to what stereo confirms."""
    from splatseed.seeding.clouds.judging import free_rays  # noqa: PLC0415  (loads Numba)

    certain = seen if scene.tracks is not None else [np.empty((0, 3))] * len(views)
    if not scene.has_photographs or len(views) < 2:
        return free_rays(views, certain) if scene.tracks is not None else None
    stereo = compare(scene, images, views, StereoSettings.grid, rng, progress)
    maps = [stereo.map(i).depth for i in range(len(views))]
    return free_rays(views, certain, [np.nan_to_num(depth, nan=np.inf) for depth in maps])


def _is_elsewhere(streamed: Streamed, scene: Scene) -> bool:
    """Whether a cloud is so far from the cameras that it only happens to be before one of them."""
    centers = np.array([image.camera.center for image in scene.images])
    first, last = centers.min(axis=0), centers.max(axis=0)
    gap = np.maximum(streamed.low - last, first - streamed.high).max()
    extent = max((streamed.high - streamed.low).max(), (last - first).max())
    return bool(gap > ELSEWHERE * extent > 0)


def _out_of_view(streamed: Streamed, scene: Scene) -> PointCloudError:
    """The error for clouds of which no point falls in any photograph, or none near a camera."""
    centers = np.array([image.camera.center for image in scene.images])
    low, high = streamed.low, streamed.high
    fix = "They are in different frames: find the transform with --align, or give it with "
    fix += "--transform FILE."
    return PointCloudError(
        "points of the cloud in view of the scene's cameras, which stand "
        f"{_span(centers.min(axis=0), centers.max(axis=0))}",
        found=f"none of {streamed.voxels.total:,}, which lie {_span(low, high)}",
        fix=fix,
    )


def _span(*corners: Float64[np.ndarray, " 3"]) -> str:
    """From corner to corner, without an exponent where digits matter."""
    first, last = (
        ", ".join(f"{x:.0f}" if GRID <= abs(x) < 1e12 else f"{x:.6g}" for x in each)
        for each in corners
    )
    return f"from ({first}) to ({last})"


def _check_fit(judged: Judged) -> tuple[str, ...]:
    """Refuse a cloud that does not lie where the scene's own points do."""
    if judged.asked < ENOUGH:
        return ()
    share = f"{judged.fit:.0%} of the scene's own points seen there"
    if judged.fit < FITS:
        raise PointCloudError(
            "a cloud that fits the scene's own points",
            found=f"{share} at its depth",
            fix="It is in another frame (try --align, or give --transform FILE), or of another "
            "place.",
        )
    doubt = ": check its frame and its unit" if judged.fit < DOUBTFUL else ""
    return (f"The cloud fits: {share} lie at its depth, within 3%{doubt}.",)


def _read_notes(streamed: Streamed) -> list[str]:
    voxels = streamed.voxels
    outside = f"{voxels.unseen:,} of them outside of every photograph"
    told = [f"{voxels.total + streamed.bad:,} points were read, {outside}."]
    told += [sentence for file in streamed.files for sentence in file.warnings]
    if streamed.bad:
        told.append(f"{streamed.bad:,} points of the cloud are not finite and were left out.")
    if voxels.coarser:
        told.append(
            f"The cloud was merged at {2**voxels.coarser} times the spacing asked for, to stay "
            "within the memory: pass more --memory."
        )
    return told
