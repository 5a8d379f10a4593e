"""The method ``cloud``: seeds from scans and dense clouds, as many as the photographs resolve.

Points stream into voxels (``voxels``); of these, those stay that a photograph sees and nothing
speaks against (``evidence``): no ray of Structure-from-Motion passes through them, the photographs
that see them agree on a colour, and they do not float alone. A budget thins them afterwards, as
those of every method.
Promise: memory does not grow with the clouds; a cloud that is nowhere near the cameras, or does not
fit the scene's own points, is refused with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatseed.errors import ParameterError, PointCloudError
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.seeding.photographs import MAX_SIZE, photographed, read_views
from splatseed.seeding.thinning import frames_of
from splatseed.similarity import Similarity
from splatseed.upsample.method import NewPoints, Traits, check_fields, require
from splatseed.upsample.registry import source_code

if TYPE_CHECKING:
    from splatseed.seeding.clouds.evidence import Evidence
    from splatseed.seeding.clouds.streaming import Streamed
    from splatseed.views.view import View

__all__ = ["Cloud", "GivenClouds"]

GIGABYTE = 1e9
FITS = 0.4
"""Below this share of the scene's own points at the cloud's depth, the cloud is another's: clouds
in the right place have 0.8 to 1, those of another 0.1 to 0.25."""
DOUBTFUL = 0.6
ENOUGH = 50
"""Points of the scene below which the share says nothing."""
AGREES = 0.5
"""Least agreement of the photographs on a point's colour, where at least ``ASKED`` see it."""
ASKED = 4
THROUGH = 2
"""Views that see through a point from which on it is not there, if fewer confirm it."""
NEIGHBORS = 8
CORNER = 0.5
"""Below this share of the photographs' cells, a note says how little the cloud covers."""
CELL = 8


@dataclass(frozen=True)
class Cloud:
    """Seeds from scans and dense clouds (--cloud), as many as the photographs resolve."""

    pixels: float = 2.0
    """Side of the voxels that merge points, in pixels of the photograph that is closest."""
    recolor: bool = False
    """Take colours from the photographs even if the cloud has some."""
    clean: bool = True
    """Leave out points that the photographs contradict, and points that float alone."""
    memory: float = 4.0
    """Most memory, in gigabytes; voxels grow where they do not fit."""

    name: ClassVar[str] = "cloud"
    traits: ClassVar[Traits] = Traits(frozenset({"cloud"}), chooses_number=True)

    def __post_init__(self) -> None:
        check_fields(self)
        require(0.25 <= self.pixels <= 64, "cloud.pixels from 0.25 to 64", self.pixels)
        require(self.memory >= 1, "cloud.memory of at least 1 gigabyte", self.memory)

    def of(self, *files: Path | str, transform: Similarity | None = None) -> GivenClouds:
        """The method for some files.

        Args:
            files: The clouds, in one frame.
            transform: From their frame to the scene's; the same frame when None.
        """
        known = {field.name: getattr(self, field.name) for field in fields(Cloud)}
        return GivenClouds(**known, files=tuple(map(str, files)), transform=transform)

    def __call__(
        self,
        scene: Scene,  # noqa: ARG002  (a method's arguments)
        num_new: int,  # noqa: ARG002
        rng: np.random.Generator,  # noqa: ARG002
        progress: Progress,  # noqa: ARG002
    ) -> NewPoints:
        """Ask for a cloud: ``of`` names it.

        Raises:
            ParameterError: Always.
        """
        raise ParameterError(
            "--cloud FILE for the method cloud", found="none", fix="Name the scan."
        )


@dataclass(frozen=True)
class GivenClouds(Cloud):
    """The method for some files; ``Cloud.of`` makes it."""

    files: tuple[str, ...] = ()
    """The clouds."""
    transform: Similarity | None = None
    """From their frame to the scene's; the same frame when None."""

    def __call__(
        self,
        scene: Scene,
        num_new: int,  # noqa: ARG002  (the photographs determine the number)
        rng: np.random.Generator,  # noqa: ARG002  (nothing is random)
        progress: Progress,
    ) -> NewPoints:
        """Seeds from the clouds.

        Raises:
            SceneNotFoundError: A file is missing.
            SceneFormatError: One is damaged.
            PointCloudError: No point is in view, or the cloud does not fit the scene.
        """
        from splatseed.seeding.clouds.streaming import capacity_of, stream  # noqa: PLC0415  (loads Numba)

        frames = _frames(scene)
        capacity = capacity_of(self.memory * GIGABYTE)
        paths = [Path(each) for each in self.files]
        streamed = stream(paths, self.transform, frames, self.pixels, capacity, progress)
        _check_in_view(streamed, scene)
        return self._choose(scene, streamed, progress)

    def _choose(self, scene: Scene, streamed: Streamed, progress: Progress) -> NewPoints:
        """The points that stay, their colours, and notes."""
        from splatseed.seeding.clouds.evidence import FreeRays, find_evidence, find_surfaces  # noqa: PLC0415  (loads Numba)
        from splatseed.views.visibility import find_visibility  # noqa: PLC0415  (loads with its use)

        voxels = streamed.voxels
        images = _images(scene)
        views = _views(scene, images, progress)
        visibility = find_visibility(scene)
        seen = [
            visibility.of(image) if len(visibility.xyz) else np.empty((0, 3)) for image in images
        ]
        surfaces, cell = find_surfaces(views, voxels.xyz, progress)
        fit = _check_fit(views, surfaces, seen)
        rays = FreeRays.of(views, seen) if scene.tracks is not None else None
        evidence = find_evidence(views, voxels.xyz, surfaces, cell, rays, progress)
        kept, fates = self._decide(voxels.xyz, evidence, progress)
        rgb = self._paint(streamed, evidence)[kept]
        confidence = np.nan_to_num(evidence.agreement, nan=AGREES)[kept]
        covered = _note_on_cover(scene, voxels.xyz[kept])
        notes = (*_read_notes(streamed), *fit, *fates, *covered)
        source = np.full(len(rgb), source_code("cloud"), np.uint8)
        return NewPoints(voxels.xyz[kept], rgb, notes, confidence=confidence, source=source)

    def _decide(
        self, xyz: np.ndarray, evidence: Evidence, progress: Progress
    ) -> tuple[Bool[np.ndarray, " N"], tuple[str, ...]]:
        """Which voxels stay, and a sentence on each reason why others do not."""
        visible = evidence.seen > 0
        if not visible.any():
            raise PointCloudError(
                "points of the cloud that a photograph sees", found="none", fix="Check the frame."
            )
        hidden = f"{np.count_nonzero(~visible):,} lie behind surfaces in every photograph"
        if not self.clean:
            return visible, (f"Of {len(xyz):,} points, {hidden}.",)
        through = visible & (evidence.through >= THROUGH) & (evidence.through > evidence.confirmed)
        differs = visible & ~through & (evidence.seen >= ASKED) & (evidence.agreement < AGREES)
        kept = visible & ~through & ~differs
        alone = np.zeros_like(kept)
        alone[kept] = _isolated(xyz[kept], progress)
        told = (
            hidden,
            f"photographs see past {np.count_nonzero(through):,}",
            f"they do not agree on {np.count_nonzero(differs):,}",
            f"{np.count_nonzero(alone):,} float alone",
        )
        return kept & ~alone, (f"Of {len(xyz):,} points, {', '.join(told)}: these are left out.",)

    def _paint(self, streamed: Streamed, evidence: Evidence) -> UInt8[np.ndarray, "N 3"]:
        """Colours: the cloud's, or the photographs' where it has none or they are preferred."""
        sampled = ~np.isnan(evidence.agreement) | (evidence.rgb != 128).any(axis=1)
        colored = all(file.has_color for file in streamed.files)
        if colored and not self.recolor:
            return streamed.voxels.rgb
        painted = all(file.colors != "none" for file in streamed.files)
        own = streamed.voxels.rgb if painted else np.full_like(evidence.rgb, 128)
        return np.where(sampled[:, None], evidence.rgb, own)


def _frames(scene: Scene) -> tuple[View, ...]:
    if not scene.images:
        raise ParameterError(
            "a scene with cameras, which choose among the points of a cloud",
            found="none",
            fix="Name the scene of the photographs; for a cloud alone: --method mls or linear.",
        )
    return frames_of(scene)


def _images(scene: Scene) -> tuple[Image, ...]:
    return photographed(scene) if scene.has_photographs else scene.images


def _views(scene: Scene, images: Sequence[Image], progress: Progress) -> tuple[View, ...]:
    """The photographs, or their frames alone if there are none."""
    if scene.has_photographs:
        return read_views(scene, images, MAX_SIZE, progress)
    return frames_of(scene)


def _check_in_view(streamed: Streamed, scene: Scene) -> None:
    """Refuse clouds of which no point falls in any photograph.

    Raises:
        PointCloudError: They are elsewhere.
    """
    if len(streamed.voxels):
        return
    centers = np.array([image.camera.center for image in scene.images])
    raise PointCloudError(
        "points of the cloud in view of the scene's cameras, which stand "
        f"{_span(centers.min(axis=0), centers.max(axis=0))}",
        found=f"none of {streamed.voxels.total:,}, which lie {_span(streamed.low, streamed.high)}",
        fix="They are in different frames: find the transform with --align, or give it with "
        "--transform FILE.",
    )


def _span(low: Float64[np.ndarray, " 3"], high: Float64[np.ndarray, " 3"]) -> str:
    first, last = (", ".join(f"{value:.6g}" for value in each) for each in (low, high))
    return f"from ({first}) to ({last})"


def _check_fit(
    views: Sequence[View], surfaces: Sequence[np.ndarray], seen: Sequence[np.ndarray]
) -> tuple[str, ...]:
    """Refuse a cloud that does not lie where the scene's own points do.

    Raises:
        PointCloudError: It is of another place, or in another frame.
    """
    from splatseed.seeding.clouds.evidence import surface_agreement  # noqa: PLC0415  (loads Numba)

    share, count = surface_agreement(views, surfaces, seen)
    if count < ENOUGH:
        return ()
    found = f"{share:.0%} of the scene's own points that are seen there lie at the cloud's depth"
    if share < FITS:
        raise PointCloudError(
            "a cloud that fits the scene's own points", found=found,
            fix="It is in another frame (try --align, or give --transform FILE), or of another "
            "place.",
        )  # fmt: skip
    doubt = ": check the frame" if share < DOUBTFUL else ""
    return (f"{found}, within 10%{doubt}.",)


def _isolated(xyz: np.ndarray, progress: Progress) -> Bool[np.ndarray, " N"]:
    """Which points lie much farther from their neighbours than these from theirs."""
    from splatseed.upsample.neighbors import prepare, sound_bases  # noqa: PLC0415  (loads SciPy)

    if len(xyz) <= NEIGHBORS:
        return np.zeros(len(xyz), bool)
    points = PointCloud(xyz, np.zeros((len(xyz), 3), np.uint8))
    distinct = np.flatnonzero(points.distinct)
    cloud = prepare(points, progress=progress)
    alone = np.zeros(len(xyz), bool)
    alone[distinct[cloud.rank]] = sound_bases(cloud, cloud.neighbors(NEIGHBORS)) == 0
    return alone


def _read_notes(streamed: Streamed) -> tuple[str, ...]:
    voxels = streamed.voxels
    outside = f"{voxels.unseen:,} of them outside of every photograph"
    told = [f"{voxels.total + streamed.bad:,} points were read, {outside}."]
    told += [sentence for file in streamed.files for sentence in file.warnings]
    if streamed.bad:
        told.append(f"{streamed.bad:,} points of the cloud are not finite and were left out.")
    if voxels.coarser:
        told.append(
            f"The cloud was merged at {2**voxels.coarser} times the spacing asked for, to stay "
            "within the memory: --cloud.memory raises it."
        )
    return tuple(told)


def _note_on_cover(scene: Scene, xyz: np.ndarray) -> tuple[str, ...]:
    from splatseed.seeding.coverage import covered_share  # noqa: PLC0415  (loads Numba)

    share = covered_share(frames_of(scene), xyz, CELL, silent)
    if share >= CORNER:
        return ()
    told = f"The cloud covers {share:.0%} of the photographs"
    return (f"{told}: --method auto beside --cloud seeds the rest.",)
