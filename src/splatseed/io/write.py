"""Writing a scene that every 3D Gaussian Splatting trainer loads unchanged.

A *layout* is the set of files that a trainer looks for: COLMAP's (``colmap_layout``),
nerfstudio's (``transforms_layout``), or both in one folder and one world. Promise: the folder
appears completely or not at all; its points are finite and distinct, in the scene's order in all
files; originals keep their float64 positions and tracks; point ids are 1..N. docs/trainers.md lists
what each trainer needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePath
from typing import Literal

from splatseed.errors import OutputError, PointCloudError
from splatseed.findings import Finding
from splatseed.io.cleaning import clean_scene
from splatseed.io.colmap_layout import write_colmap_layout
from splatseed.io.files import StrPath
from splatseed.io.image_folders import link_folders, photographs_hidden
from splatseed.io.mask_files import FOLDER as MASKS
from splatseed.io.masks import write_masks
from splatseed.io.origin import write_offset
from splatseed.io.recordings import is_extracted
from splatseed.io.seeds import facts_for_reading
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.io.transforms_layout import (
    Layout,
    forget_masks,
    rewrites_masks,
    write_both_layouts,
    write_transforms_layout,
)
from splatseed.requirements import versions_of
from splatseed.scene import Scene

_KIND = "write_scene"
"""The kind of an output whose provenance names no verb."""
_PACKAGES = ("splatseed", "numpy", "scipy", "numba")


@dataclass(frozen=True)
class WriteReport:
    """Files, counts and findings of a written scene.

    Dropped points, counted since reading, had a coordinate that is not finite or the position of an
    earlier point. ``files`` are paths inside the folder; image folders are named, not listed.
    """

    path: Path
    layout: Layout
    num_points: int
    num_original: int
    dropped_nonfinite: int
    dropped_duplicates: int
    files: tuple[str, ...]
    findings: tuple[Finding, ...]


def write_scene(
    scene: Scene,
    path: StrPath,
    *,
    format: Literal["auto", "colmap", "transforms"] = "auto",  # noqa: A002  (the user's word)
    overwrite: bool = False,
    copy_images: bool = False,
    provenance: Mapping[str, object] | None = None,
    require_points: bool = True,
) -> WriteReport:
    """Write a scene folder for training.

    Args:
        scene: The scene, originals first in its cloud.
        path: The folder to create.
        format: The layout. ``auto`` is COLMAP's, and both for a scene from a ``transforms.json``
            unless they disturb each other.
        overwrite: Whether an earlier output of splatseed may be replaced.
        copy_images: Copy the image folders instead of linking them.
        provenance: Entries for ``splatseed.json`` on how the points were made.
        require_points: Whether to refuse a scene without points.

    Raises:
        OutputError: The folder exists, overlaps the input or cannot be written, or the layout
            cannot hold the scene.
        PointCloudError: No point is finite, or there is none although ``require_points``.
    """
    path, layout, made = Path(path), _choose_layout(scene, format), dict(provenance or {})
    source, clean = scene.source, clean_scene(scene)  # one from load_scene is clean already
    required = require_points or bool(len(scene.points))
    if required and not len(clean.points):
        raise PointCloudError(
            "at least one point with finite coordinates",
            found=f"{len(scene.points)} points, none of them finite",
            fix="Check the cloud.",
        )
    kind = str(made.get("command", _KIND))
    with output_folder(path, kind=kind, overwrite=overwrite, protect=source.inputs) as folder:
        if layout == "both":
            (findings, image_sources, offset), layout = write_both_layouts(clean, folder)
        else:
            write = write_colmap_layout if layout == "colmap" else write_transforms_layout
            findings, image_sources, offset = write(clean, folder)
            if layout == "colmap" and (hidden := photographs_hidden(image_sources, clean)):
                text = f"{hidden}: remove the folder's link before you train with it."
                findings.append(Finding("hidden-photographs", text))
        write_offset(folder, offset)
        masks, photographs = clean.masks, source.image_dir
        if masks and photographs and rewrites_masks(clean, layout):
            image_sources.pop(MASKS, None)
            alone = replace(masks, alpha=False)  # photographs keep their transparency
            names = [image.name for image in clean.images if image.has_photograph]
            write_masks(alone, photographs, names, folder / MASKS)
            if layout != "colmap" and not (folder / MASKS).is_dir():
                forget_masks(folder)  # no photograph has a masked pixel
        linked = link_folders(image_sources, folder, copy=copy_images)
        tops = {PurePath(each).parts[0] for each in linked}
        own = [each for each in folder.rglob("*") if each.relative_to(folder).parts[0] not in tops]
        files = [each.relative_to(folder).as_posix() for each in own if not each.is_dir()]
        counts = {
            "num_points": len(clean.points),
            "num_original": clean.points.num_original,
            "dropped_nonfinite": clean.left_out.non_finite,
            "dropped_duplicates": clean.left_out.duplicates,
        }
        is_file = source.format == "ply" or (source.root and is_extracted(source.root))
        read = source.transforms_path or (source.points_path if is_file else source.root)
        num_new = counts["num_points"] - counts["num_original"]
        made |= facts_for_reading(scene)
        facts = {"source": read and str(read), **made, "format": layout, **counts}
        # Not what was chosen or how long it took: the same seed gives the same bytes.
        kept = [each for each in (*scene.findings, *findings) if each.severity != "info"]
        found = [asdict(each) for each in kept]
        facts |= {"num_new": num_new, "findings": found}
        write_json(folder / MANIFEST, {**facts, "versions": versions_of(_PACKAGES)})
    return WriteReport(
        path,
        layout,
        **counts,
        files=tuple(sorted([*files, *linked, MANIFEST])),
        findings=tuple(findings),
    )


def _choose_layout(scene: Scene, wanted: str) -> Layout:
    if wanted == "auto":
        return "both" if scene.source.format == "transforms" and scene.images else "colmap"
    if wanted == "colmap":
        return "colmap"
    if wanted == "transforms" and scene.images:
        return "transforms"
    known = "a format of auto, colmap or transforms, which needs images"
    raise OutputError(known, found=repr(wanted), fix="Write the COLMAP layout (`format='colmap'`).")
