"""Methods that read the photographs and choose the number of seeds themselves.

``stereo`` compares photographs and puts seeds on the surfaces it finds; ``cover`` puts a seed into
every cell of every photograph that holds no point; ``auto`` does both. Photographs of test views
are never read. ``--help`` reads the settings here, so that kernels are imported where a method
runs.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from jaxtyping import Float32

from splatseed.camera import Camera
from splatseed.depth.stereo.maps import MAX_GRID, MIN_POINTS, StereoSettings
from splatseed.depthmap import MIN_CONFIDENCE, in_scene_units
from splatseed.errors import (
    MissingDependencyError,
    PointCloudError,
    SceneNotFoundError,
    TaskLostError,
)
from splatseed.findings import Finding
from splatseed.io.regions import Region
from splatseed.methods import Traits, source_code
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.view import View, camera_views
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Note, Progress, StageTimes, silent_note, watched
from splatseed.scene import Image, Scene
from splatseed.settings import Range, check_settings
from splatseed.text import agreeing, counted, name_some

if TYPE_CHECKING:
    from splatseed.depth.stereo.maps import StereoMap, StereoResult

MAX_SIZE = 800
"""Longer side, in pixels, of the photographs that methods compare."""
CELL = 8
"""Side, in pixels, of the cells in which cover looks for points."""
MAX_ODD_SHARE, MIN_MEDIAN_SHARE = 0.1, 0.2
"""Of a photograph's confirmed pixels, as a fraction of the median over photographs, up to which it
does not fit; and of this median. Of another place or pose it is 0.06, in twelve captures 0.2 or
more, or the median is lower."""


@dataclass(frozen=True)
class PhotographMethod:
    """Settings that ``stereo``, ``cover`` and ``auto`` share."""

    max_size: Annotated[int, Range(64)] = MAX_SIZE
    """Maximum side of photographs in pixels; larger ones are reduced by a whole factor."""
    test_every: Annotated[int, Range(2, also=0)] = 0
    """Leave out every n-th image by name, as trainers do for testing (8); 0 = use all but
    test images that the scene lists."""

    name: ClassVar[str]
    traits: ClassVar[Traits] = Traits(frozenset({"photographs"}), chooses_number=True)

    def __post_init__(self) -> None:
        check_settings(self, self.name)


@dataclass(frozen=True)
class Stereo(PhotographMethod):
    """Seeds on surfaces that are found by comparing the photographs."""

    spacing: Annotated[float, Range(1, 256)] = 8.0
    """Pixels between seeds in the photographs; at least the grid."""
    grid: Annotated[int, Range(1, MAX_GRID)] = 4
    """Pixels between depths, along a row and a column."""
    dense: bool = True
    """Under a budget, make as many seeds as it allows where photographs confirm them; else thin
    those that are `spacing` apart."""
    depth_maps: bool = True
    """Without points, begin at the depth of the scene's maps, if there are any."""

    name: ClassVar[str] = "stereo"

    def maps(
        self, scene: Scene, only: Sequence[int], seed: int, progress: Progress
    ) -> tuple[StereoMap, ...]:
        """Compute the depth maps that ``upsample`` makes with this seed.

        ``only`` are indices into ``photographed(scene, test_every)``.
        """
        images = photographed(scene, self.test_every)
        views = read_views(scene, images, self.max_size, progress)
        rng = np.random.default_rng(seed)
        guided, _ = self._guided(scene, images)
        stereo = compare(guided, images, views, self.grid, rng, progress, only)
        return tuple(stereo.map(i) for i in only)

    def __call__(
        self,
        scene: Scene,
        num_new: int,
        rng: np.random.Generator,
        progress: Progress,
        *,
        budget: int | None = None,
        region: Region | None = None,
        note: Note = silent_note,
        on_stereo: Callable[[StereoResult], None] | None = None,
    ) -> PointCloud:
        """Make the points of a scene; ``num_new`` is ignored.

        Without points, the scene's poses are checked first. With ``dense``, the photographs are
        compared again where that fills the ``budget``, with points in the region alone.
        """
        from splatseed.depth.stereo.fusion import fuse
        from splatseed.seeding.dense import Comparison, fill_budget

        images, times = photographed(scene, self.test_every), StageTimes()

        def timed(stage: str, fraction: float) -> None:
            times(stage, fraction)
            progress(stage, fraction)

        with watched(times.compilation):
            findings = () if has_points(scene) else _check_given_poses(scene, images, timed)
            guided, mismatch = self._guided(scene, images)
            views = read_views(scene, images, self.max_size, timed)
            start = time.perf_counter()
            stereo = compare(guided, images, views, self.grid, rng, timed)
            seeds = fuse(stereo, self.spacing, timed).with_source(source_code("stereo"))
            found = _confirmed_share(scene, stereo, time.perf_counter() - start)
            for finding in (*found, *findings, *mismatch):
                note(finding)
            known = PointCloud.concatenate(scene.points.originals, seeds)
            cameras = [view.camera for view in views]
            few = self.fills_pixels(scene, cameras, known.xyz[known.finite])
            triangulated = PointCloud.empty()
            if not few:
                triangulated = self.triangulate(scene, views, timed, note)
            if len(triangulated):  # known from here on, like a scene's points
                scene = scene.replace(points=triangulated.with_source(ORIGINAL), tracks=None)
            points = self.fill(scene, seeds, stereo, rng, timed, note, few=few)
        if on_stereo is not None:
            on_stereo(stereo)
        if budget is None or not self.dense or few:
            return PointCloud.concatenate(triangulated, points)
        first = Comparison(images, stereo, self.max_size, self.spacing, times.seconds())

        def refill(denser: PointCloud) -> PointCloud:
            return self.fill(scene, denser, stereo, rng, progress, silent_note, few=False)

        counted_in = scene
        if region is not None and len(triangulated):  # which are dropped outside of it
            kept = triangulated.select(region(triangulated.xyz))
            counted_in = scene.replace(points=kept.with_source(ORIGINAL))
        points = fill_budget(counted_in, first, points, budget, refill, rng, progress, note, region)
        return PointCloud.concatenate(triangulated, points)

    def _guided(self, scene: Scene, images: Sequence[Image]) -> tuple[Scene, tuple[Finding, ...]]:
        """Return the scene without depth maps that stereo must not start at, and why."""
        if scene.depths is None or has_depth_hints(scene):
            return scene, ()
        if not self.depth_maps:
            return scene.replace(depths=None), ()
        from splatseed.depth.kinds import UNIT_MISMATCH
        from splatseed.seeding.map_seeds import unit_ratio

        ratio = unit_ratio(scene, images)
        if ratio is None:
            return scene, ()
        text = (
            "The scene's depth maps do not guide stereo: "
            f"their depth is {ratio:.4g} times that of the photographs."
        )
        return scene.replace(depths=None), (Finding(UNIT_MISMATCH, text),)

    def fill(
        self,
        scene: Scene,
        seeds: PointCloud,
        stereo: StereoResult,
        rng: np.random.Generator,
        progress: Progress,
        note: Note,
        *,
        few: bool,
    ) -> PointCloud:
        """Add seeds where stereo found none; this method adds none."""
        return seeds

    def fills_pixels(
        self, scene: Scene, cameras: Sequence[Camera], xyz: Float32[np.ndarray, "M 3"]
    ) -> bool:
        """Whether ``fill`` makes seeds as dense as the pixels; this method does not."""
        return False

    def triangulate(
        self, scene: Scene, views: Sequence[View], progress: Progress, note: Note
    ) -> PointCloud:
        """Triangulate points of features as further seeds; this method does not."""
        return PointCloud.empty()


@dataclass(frozen=True)
class Cover(PhotographMethod):
    """A seed for every cell of every photograph that holds no point."""

    cell: Annotated[int, Range(1, 256)] = CELL
    """Side of a cell in pixels."""

    name: ClassVar[str] = "cover"

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> PointCloud:
        """Make the points of a scene from the depths of its originals; ``num_new`` is ignored."""
        originals = scene.points.originals
        if not originals.finite.any():
            raise PointCloudError(
                "points whose depths method 'cover' can carry into the gaps",
                found="none",
                fix="Choose `method='auto'`, which compares the photographs first.",
            )
        views = read_views(scene, photographed(scene, self.test_every), self.max_size, progress)
        return _cover(views, originals, self.cell, rng, progress)


@dataclass(frozen=True)
class Auto(Stereo):
    """Stereo, then cover: a seed for every cell of every photograph, on surfaces where possible."""

    cell: Annotated[int, Range(1, 256)] = CELL
    """Side in pixels of a cell that gets a seed if it holds no point."""
    depth_maps: bool = True
    """Use the depth maps that come with a capture (a LiDAR's, a Kinect's): without points begin at
    their depth, and take theirs where photographs confirm none."""
    min_confidence: Annotated[int, Range(0, 2)] = MIN_CONFIDENCE
    """Where photographs confirm none, use depth from this confidence on, if maps have one: 0 low,
    1 medium, 2 high."""

    name: ClassVar[str] = "auto"

    def fill(
        self,
        scene: Scene,
        seeds: PointCloud,
        stereo: StereoResult,
        rng: np.random.Generator,
        progress: Progress,
        note: Note,
        *,
        few: bool,
    ) -> PointCloud:
        """Add a seed in each cell that stereo leaves empty, at a measured depth if there is one."""
        known = PointCloud.concatenate(scene.points.originals, seeds)
        if few:
            from splatseed.seeding.few_photographs import pixel_seeds

            num = len(stereo.views)
            text = f"Few photographs ({num}): semi-global matching gives every second pixel a seed."
            note(Finding("few-photographs", text, "info"))
            return pixel_seeds(stereo.views, known.xyz.astype(np.float64), progress)
        if self.uses_maps(scene):
            measured = self._from_maps(scene, stereo, known, progress, note)
            seeds = PointCloud.concatenate(seeds, measured)
            known = PointCloud.concatenate(known, measured)
        guessed = _cover(stereo.views, known, self.cell, rng, progress)
        return PointCloud.concatenate(seeds, guessed)

    def fills_pixels(
        self, scene: Scene, cameras: Sequence[Camera], xyz: Float32[np.ndarray, "M 3"]
    ) -> bool:
        """Whether photographs are so few that each pixel needs a depth; not if maps have it."""
        from splatseed.seeding.few_photographs import are_few

        if self.uses_maps(scene):
            return False
        has_points = len(scene.points.originals) > 0
        return are_few(cameras, xyz.astype(np.float64), has_points=has_points)

    def triangulate(
        self, scene: Scene, views: Sequence[View], progress: Progress, note: Note
    ) -> PointCloud:
        """Triangulate points of features, if there are neither points nor measured depths."""
        known = len(scene.points.originals) or self.uses_maps(scene)
        if known:
            return PointCloud.empty()
        try:
            from splatseed.sfm.triangulation import triangulate

            points = triangulate(views, progress)
        except (MissingDependencyError, TaskLostError) as error:
            text = "No points are triangulated, which auto would add to those of stereo: expected "
            text += f"{error.expected}, found {error.found}."
            note(Finding("points-not-triangulated", text, "info", fix=error.fix))
            return PointCloud.empty()
        text = f"{len(points):,} points are triangulated from features, at the poses as given."
        note(Finding("triangulated-points", text, "info"))
        return points.with_source(source_code("stereo"))

    def uses_maps(self, scene: Scene) -> bool:
        """Whether the scene has measured depth maps that count."""
        return self.depth_maps and in_scene_units(scene.depths)

    def _from_maps(
        self, scene: Scene, stereo: StereoResult, known: PointCloud, progress: Progress, note: Note
    ) -> PointCloud:
        """Make the seeds that the scene's depth maps give where stereo found none."""
        from splatseed.seeding.map_seeds import cell_maps, in_scene_unit, seeds_from_maps

        assert scene.depths is not None  # noqa: S101  (they are in scene units)
        images = photographed(scene, self.test_every)
        maps = cell_maps(
            stereo.views, images, scene.depths, self.cell, self.min_confidence, progress
        )
        maps, left_out = in_scene_unit(stereo, [image.name for image in images], maps)
        xyz = known.xyz[known.finite]
        seeds = seeds_from_maps(stereo.views, xyz, maps, stereo.sources, self.cell, progress)
        for finding in left_out:
            note(finding)
        if num := sum(bool(np.isfinite(each).any()) for each in maps):
            of = counted(num, "depth map")
            text = f"Where photographs confirm no depth, it is that of the scene's {of}."
            note(Finding("depth-maps-used", text, "info"))
        return seeds


def has_points(scene: Scene) -> bool:
    """Whether there are enough points to trust the poses."""
    points = scene.points.originals
    return int(np.count_nonzero(points.distinct)) >= MIN_POINTS


def has_depth_hints(scene: Scene) -> bool:
    """Whether there are enough points for stereo to take its depth ranges from them."""
    from splatseed.depth.stereo.pipeline import has_enough_points
    from splatseed.photos.visibility import find_visibility

    return has_enough_points(find_visibility(scene), scene.images)


def photographed(
    scene: Scene, test_every: int = 0, *, without: str = "choose `method='mls'`"
) -> tuple[Image, ...]:
    """Return the images whose photographs methods read, by name; test views are left out.

    Args:
        scene: Images whose files are missing are left out.
        test_every: As in ``PhotographMethod``.
        without: What to do without photographs, for the message.
    """
    ordered = sorted(scene.images, key=lambda image: image.name)
    used = list(scene.split(test_every)[0]) if test_every or scene.listed else ordered
    if ordered and not used:
        raise SceneNotFoundError(
            "photographs other than test views",
            found=f"none: all {len(ordered)} are test views",
            fix="Add photographs to the scene.",
        )
    used = [image for image in used if image.has_photograph]
    if not used:
        missing = f"none of {len(ordered)} images"
        raise SceneNotFoundError(
            "photographs of the scene",
            found=missing if scene.source.image_dir else "no folder with images",
            fix=f"Put them into a folder named images beside the model, or {without}.",
        )
    return tuple(used)


def read_views(
    scene: Scene, images: Sequence[Image], max_size: int, progress: Progress
) -> tuple[View, ...]:
    """Read the photographs of some images, undistorted, at most ``max_size`` pixels a side."""
    factor = factor_for_size(images, max_size)
    return load_views(scene, images, data_factor=factor, undistort=True, progress=progress)


def frames_of(scene: Scene) -> tuple[View, ...]:
    """Return the views of all images at ``MAX_SIZE``, without pixels."""
    images = scene.images
    return camera_views(images, factor_for_size(images, MAX_SIZE)) if images else ()


def compare(
    scene: Scene,
    images: Sequence[Image],
    views: Sequence[View],
    grid: int,
    rng: np.random.Generator,
    progress: Progress,
    only: Sequence[int] | None = None,
) -> StereoResult:
    """Run stereo with depths ``grid`` pixels apart; only as far as the views ``only`` need it."""
    from splatseed.depth.stereo.pipeline import find_stereo, known_visibility

    settings, seed = StereoSettings(grid=grid), int(rng.integers(1 << 32))
    return find_stereo(views, images, known_visibility(scene), settings, seed, progress, only)


def with_cover(
    views: Sequence[View], points: PointCloud, cell: int, seed: int, progress: Progress
) -> PointCloud:
    """Add a seed for every cell of the views, ``cell`` pixels wide, that holds no point."""
    rng = np.random.default_rng([seed, source_code("cover")])
    return PointCloud.concatenate(points, _cover(views, points, cell, rng, progress))


def _cover(
    views: Sequence[View],
    cloud: PointCloud,
    cell: int,
    rng: np.random.Generator,
    progress: Progress,
) -> PointCloud:
    from splatseed.seeding.cover import cover

    xyz, masks = cloud.xyz[cloud.finite], [view.surface for view in views]
    return cover(views, xyz, cell=cell, rng=rng, masks=masks, progress=progress)


def _confirmed_share(scene: Scene, stereo: StereoResult, seconds: float) -> tuple[Finding, ...]:
    """Report the share of pixels with depth, and the time, if points could not guide stereo.

    Photographs that others hardly confirm are named: no points have checked their poses.
    """
    if has_depth_hints(scene):
        return ()
    points = "too few" if len(scene.points) else "no"
    shares = [float(stereo.confirmed(i).mean()) for i in range(len(stereo.views))]
    text = (
        f"With {points} points to start from, stereo gave {np.mean(shares):.0%} of the "
        f"photographs' pixels a confirmed depth, in {seconds:.0f} s."
    )
    found = Finding("confirmed-depth", text, "info")
    median = float(np.median(shares))
    odd = tuple(
        view.name
        for view, share in zip(stereo.views, shares, strict=True)
        if share <= MAX_ODD_SHARE * median and view.surface is None  # masked pixels confirm nothing
    )
    if not odd or median < MIN_MEDIAN_SHARE:
        return (found,)
    count = f"{counted(len(odd), 'photograph')} {agreeing(len(odd), 'does', 'do')}"
    text = (
        f"{count} not fit the others, which confirm almost no depth there ({median:.0%} in the "
        f"median photograph): {name_some(odd)}. A wrong pose, or another place."
    )
    fix = "`exclude` leaves such photographs out."
    return found, Finding("photographs-disagree", text, subjects=odd, fix=fix)


def _check_given_poses(
    scene: Scene, images: Sequence[Image], progress: Progress
) -> tuple[Finding, ...]:
    """Check the poses of a scene without points."""
    from splatseed.checkup.focal_by_pairs import find_focal_length
    from splatseed.checkup.pose_accuracy import given_pose_error
    from splatseed.checkup.poses import agreement_findings, check_poses

    faint = agreement_findings(check_poses(scene, images, progress), stated=True)
    error = given_pose_error(scene, images, progress)
    wrong = find_focal_length(scene, images, error, progress)
    return (*faint, *(wrong or (error.findings if error else ())))
