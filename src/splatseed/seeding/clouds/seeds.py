"""Seeds from clouds: merge the points, keep those that photographs see, check the frame.

Points are merged in voxels while they are read (``reading``); voxels that a photograph sees and
none contradicts become seeds (``photo_consistency``). A cloud that is far from the cameras, or does
not fit the scene's own points, is refused.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64, UInt8

from splatseed.depth.stereo.maps import StereoSettings
from splatseed.errors import PointCloudError
from splatseed.findings import Finding
from splatseed.io.origin import LIMITS
from splatseed.photos.view import View
from splatseed.photos.visibility import find_visibility
from splatseed.pointcloud import PointCloud
from splatseed.progress import Note, Progress, silent
from splatseed.sampling import strided
from splatseed.scene import Image, Scene
from splatseed.seeding.clouds.photo_consistency import (
    ConsistentVoxels,
    SurfaceDepths,
    colors_of_points,
    consistent_voxels,
    free_space,
)
from splatseed.seeding.clouds.point_colors import ALIKE, encoded_if_linear, lacks_color
from splatseed.seeding.clouds.reading import MergedCloud, read_clouds
from splatseed.seeding.clouds.settings import CloudInputs, CloudSettings
from splatseed.seeding.cover import covered_share
from splatseed.seeding.photo_methods import (
    CELL,
    MAX_SIZE,
    compare,
    frames_of,
    photographed,
    read_views,
)

MIN_FIT, DOUBTFUL_FIT = 0.2, 0.55
"""Minimum fraction of the scene's own points at the cloud's depth, and the fraction below which a
note warns: a cloud of another place has 0 to 0.1, one in the right place 0.36 (red kitchen, noisy)
to 0.92 (room0)."""
MIN_COMPARED = 50  # points of the scene below which this fraction is not meaningful
UNKNOWN_CONFIDENCE = 0.5  # of a point that fewer than two photographs see
LOW_COVERAGE = 0.5  # fraction of the photographs' cells below which a note says so
LINEAR_SAMPLE = 20_000  # voxels whose colours are compared with the photographs'
NATIONAL_GRID = 1e5  # coordinates from here on, in metres, are printed in full


def cloud_seeds(
    scene: Scene,
    settings: CloudSettings,
    inputs: CloudInputs,
    rng: np.random.Generator,
    progress: Progress,
    note: Note,
) -> PointCloud:
    """Make seeds from files, for a scene with cameras."""
    frames = frames_of(scene)
    merged = read_clouds(
        inputs.paths, inputs.scene_from_cloud, frames, settings.pixels, inputs.capacity, progress,
        settings.columns,
    )  # fmt: skip
    voxels, images, views = merged.voxels, scene.images, frames
    if not len(voxels) or _is_elsewhere(merged, scene):
        raise _out_of_view(merged, scene)
    if scene.has_photographs:
        images = photographed(scene, settings.test_every)
        views = read_views(scene, images, MAX_SIZE, progress)
    visibility = find_visibility(scene)
    none = np.empty((0, 3))
    visible = [visibility.of(image) if len(visibility.xyz) else none for image in images]
    has_rgb = _has_rgb(merged)
    colors = _encoded(merged, views, progress, note) if has_rgb else None
    free = _free_space(scene, images, views, visible, rng, progress) if settings.clean else None
    selected = consistent_voxels(
        views, visible, voxels, colors, progress, clean=settings.clean, free=free
    )
    xyz = voxels.xyz[selected.kept]
    share = covered_share(frames, xyz, CELL, silent)
    findings = [*_reading_findings(merged), *_check_fit(selected)]
    findings.append(_kept_points(selected, len(voxels)))
    if scene.has_photographs and not has_rgb:
        text = f"The cloud has {_found_colors(merged)}: colours are from the photographs."
        findings.append(Finding("colors-of-photographs", text, "info"))
    elif scene.has_photographs and (number := int(selected.uncolored.sum())):
        text = (
            f"{number:,} of {len(xyz):,} seeds have no colour in the cloud (black, or one colour "
        )
        text += "that the photographs contradict): theirs is from the photographs."
        findings.append(Finding("colors-of-photographs", text, "info"))
    if share < LOW_COVERAGE:
        hint = ": `method='auto'` with `cloud` seeds the rest" if inputs.alone else ""
        text = f"The cloud covers {share:.0%} of the photographs{hint}."
        findings.append(Finding("low-coverage", text))
    for finding in findings:
        note(finding)
    agreement = np.nan_to_num(selected.evidence.agreement, nan=UNKNOWN_CONFIDENCE)
    rgb = selected.evidence.rgb
    has_any = all(file.colors != "none" for file in merged.files)
    if has_any and not (scene.has_photographs and (settings.recolor or colors is None)):
        rgb = (voxels.rgb if colors is None else colors)[selected.kept]
        if scene.has_photographs:
            rgb = np.where(selected.uncolored[:, None], selected.evidence.rgb, rgb)
    return PointCloud(xyz, rgb, confidence=agreement)


def _encoded(
    merged: MergedCloud, views: Sequence[View], progress: Progress, note: Note
) -> UInt8[np.ndarray, "N 3"]:
    """Return the cloud's own colours, encoded as the photographs' where the file's are linear."""
    voxels = merged.voxels
    if not all(file.may_be_linear for file in merged.files) or not views[0].photograph.size:
        return voxels.rgb
    sample = strided(np.flatnonzero(voxels.has_color), LINEAR_SAMPLE)
    seen = colors_of_points(views, voxels.xyz[sample], progress)
    encoded = encoded_if_linear(voxels.rgb, seen, sample)
    if encoded is None:
        return voxels.rgb
    text = "The cloud's colours are linear, as the photographs show: they were encoded as sRGB."
    note(Finding("linear-colors", text, "info"))
    return encoded


def _has_rgb(merged: MergedCloud) -> bool:
    """Whether all files have colours, and not one colour for nearly all points."""
    named = all(file.colors == "rgb" for file in merged.files)
    return bool(named and lacks_color(merged.voxels.rgb).mean() < ALIKE)


def _found_colors(merged: MergedCloud) -> str:
    if all(file.colors == "rgb" for file in merged.files):
        return "one colour only"
    if all(file.colors != "none" for file in merged.files):
        return "intensity only"
    if any(file.colors != "none" for file in merged.files):
        return "colours in some files only"
    return "no colours"


def _kept_points(selected: ConsistentVoxels, total: int) -> Finding:
    dropped = [f"{selected.num_hidden:,} are hidden in every photograph"]
    dropped += [f"{count:,} {reason}" for reason, count in selected.dropped.items() if count]
    text = f"Kept {len(selected.kept):,} of {total:,} merged points: {', '.join(dropped)}."
    return Finding("contradicted-points", text, "info")


def _free_space(
    scene: Scene,
    images: Sequence[Image],
    views: Sequence[View],
    visible: Sequence[Float64[np.ndarray, "M 3"]],
    rng: np.random.Generator,
    progress: Progress,
) -> Sequence[SurfaceDepths] | None:
    """Return how far rays are free: up to tracked points, and up to what stereo confirms."""
    certain = visible if scene.tracks is not None else [np.empty((0, 3))] * len(views)
    if not scene.has_photographs or len(views) < 2:
        return free_space(views, certain) if scene.tracks is not None else None
    stereo = compare(scene, images, views, StereoSettings.grid, rng, progress)
    maps = [stereo.map(i).depth for i in range(len(views))]
    return free_space(views, certain, [np.nan_to_num(depth, nan=np.inf) for depth in maps])


def _is_elsewhere(merged: MergedCloud, scene: Scene) -> bool:
    """Whether a cloud is so far from the cameras that one of them contains it only by chance."""
    centers = np.array([image.camera.center for image in scene.images])
    first, last = centers.min(axis=0), centers.max(axis=0)
    gap = np.maximum(merged.low - last, first - merged.high).max()
    extent = max((merged.high - merged.low).max(), (last - first).max())
    return bool(gap > LIMITS.other_frame * extent > 0)


def _out_of_view(merged: MergedCloud, scene: Scene) -> PointCloudError:
    """Return the error for clouds of which no point is in a photograph, or none near a camera."""
    centers = np.array([image.camera.center for image in scene.images])
    return PointCloudError(
        "points of the cloud in view of the scene's cameras, which stand "
        f"{_span(centers.min(axis=0), centers.max(axis=0))}",
        found=f"none of {merged.voxels.total:,}, which lie {_span(merged.low, merged.high)}",
        fix="They are in different frames: find the transform with `align=True`, or pass "
        "`transform`.",
    )


def _span(*corners: Float64[np.ndarray, " 3"]) -> str:
    """Format a box, without exponents for the coordinates of a national grid."""
    first, last = (
        ", ".join(f"{x:.0f}" if NATIONAL_GRID <= abs(x) < 1e12 else f"{x:.6g}" for x in corner)
        for corner in corners
    )
    return f"from ({first}) to ({last})"


def _check_fit(selected: ConsistentVoxels) -> tuple[Finding, ...]:
    """Report how well the cloud fits the scene's own points.

    Raises:
        PointCloudError: It does not.
    """
    if selected.num_compared < MIN_COMPARED:
        return ()
    share = f"{selected.fit:.0%} of the scene's own points seen there"
    if selected.fit < MIN_FIT:
        raise PointCloudError(
            "a cloud that fits the scene's own points",
            found=f"{share} at its depth",
            fix="It shows another place, or is in another frame: try `align=True`, or pass "
            "`transform`.",
        )
    doubtful = selected.fit < DOUBTFUL_FIT
    doubt = ": check its frame and its unit" if doubtful else ""
    text = f"The cloud fits: {share} lie at its depth, within 3%{doubt}."
    return (Finding("cloud-fit", text, "warning" if doubtful else "info"),)


def _reading_findings(merged: MergedCloud) -> list[Finding]:
    voxels = merged.voxels
    outside = f"{voxels.num_outside:,} of them outside of every photograph"
    text = f"{voxels.total + merged.non_finite:,} points were read, {outside}."
    findings = [Finding("cloud-read", text, "info")]
    findings += [finding for file in merged.files for finding in file.findings]
    if merged.non_finite:
        text = f"{merged.non_finite:,} points of the cloud are not finite and were left out."
        findings.append(Finding("non-finite-points", text))
    if voxels.coarsening:
        text = (
            f"The cloud was merged at {2**voxels.coarsening} times the spacing asked for, to stay "
            "within the memory: pass more `memory`."
        )
        findings.append(Finding("coarser-voxels", text))
    return findings
