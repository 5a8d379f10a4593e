"""What the exports of photogrammetry programs and SLAM share: lenses, photographs, one scene.

A *shot* is a photograph as an export describes it. Poses are ``world_from_cam`` in OpenCV's axes,
pixels count from the image corner: readers convert to both. Exports name photographs by paths of
another computer, or without suffix; they are searched for by name near the export.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics
from splatseed.errors import SceneNotFoundError
from splatseed.findings import Finding, Severity
from splatseed.io.camera_records import (
    Lens,
    NotFiniteError,
    check_enough,
    check_record,
    left_out,
    make_intrinsics,
    require_finite,
    rigid_pose,
    unusable_findings,
)
from splatseed.io.colmap_model import IMAGE_DIRS
from splatseed.io.files import IMAGE_SUFFIXES, files_below, is_hidden, open_file, translate_errors
from splatseed.io.mask_files import masks_among
from splatseed.io.origin import recentered
from splatseed.io.photograph import lens_findings
from splatseed.io.photograph_checks import Size, photograph_findings, photograph_size
from splatseed.io.ply import read_ply_float64
from splatseed.io.point_files import differing_points, first_with_points
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource
from splatseed.text import agreeing, counted

EXPORT_AGAIN = "Export the cameras again."
_NO_PHOTOGRAPHS = ("mask", "depth", "normal", "segment")
"""Parts of the names of folders whose pictures are no photographs."""
_GAUSSIANS = b"f_dc_0"
"""A property of a PLY file of Gaussians, which are no points to start from."""
_R8 = "BROWN_R8"
"""Brown's model with a term of r^8: fx fy cx cy k1 k2 p1 p2 k3 k4. COLMAP has none."""
_GREY = 128
"""Of points without a colour."""
_MAX_ERROR = 0.1
"""Pixels by which a lens may be off before it is a warning."""

Points = tuple[PointCloud, Float64[np.ndarray, "N 3"], Path | None]
"""A cloud, its positions in float64, and its file; None if that is the file of the poses."""


class Shot(NamedTuple):
    """A photograph, its camera and its pose."""

    where: str  # file and record, for errors
    name: str  # as the export has it: a file's name or path, perhaps without suffix
    size: Size | None  # that the lens belongs to; None: the photograph's own
    lens: Callable[[Size], Lens]  # for that size; may raise ``NotFiniteError``
    world_from_cam: Float64[np.ndarray, "R 4"]  # OpenCV axes; 3 or 4 rows


@dataclass(frozen=True, eq=False)
class Export:
    """What a file of cameras holds."""

    program: str  # ``SceneSource.format``
    track: Path
    shots: Sequence[Shot]
    convention: str  # ``SceneSource.convention``
    unposed: Sequence[str] = ()  # names of photographs that have no pose
    disabled: Sequence[str] = ()  # names of those that the user has disabled
    folder: Path | None = None  # of the photographs, if shots have their exact names
    points: Points | None = None  # None: those of a PLY file beside it
    findings: Sequence[Finding] = ()


def with_r8(lens: Lens, k4: float) -> Lens:
    """Add a term of r^8 to a lens of ``brown``: a model that ``make_scene`` approximates."""
    terms = (*lens[1][4:], 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    return (_R8, (*lens[1][:4], *terms, k4)) if k4 else lens


def _without_r8(where: str, lens: Lens, size: Size) -> tuple[Lens, float]:
    """Fit FULL_OPENCV's ratio of polynomials in r^2 within the image; return its error in px."""
    if lens[0] != _R8:
        return lens, 0.0
    fx, fy, cx, cy, k1, k2, p1, p2, k3, k4 = lens[1]
    if not (np.isfinite(lens[1]).all() and min(fx, fy) > 0):
        return ("OPENCV", lens[1][:8]), 0.0  # which its check refuses
    with np.errstate(all="ignore"):  # checked below
        corner = np.hypot(max(cx, size[0] - cx) / fx, max(cy, size[1] - cy) / fy)
        r = np.linspace(0, 2 * corner, 4001)
        t = r * r
        radial = 1 + t * (k1 + t * (k2 + t * (k3 + t * k4)))
        beyond = (r * radial > corner) | (np.gradient(r * radial, r) <= 0)
    used = slice(0, int(beyond.argmax()) or len(r))
    r, t, radial = r[used, None], t[used, None], radial[used, None]
    plausible = 1e-6 < t[-1, 0] < 1e6 and np.abs(radial).max() < 1e6  # not NaN either
    require_finite(bool(plausible), "a lens that does not fold", where, lens[1])
    # numerator - radial * (denominator - 1) = radial is linear in the six coefficients. The
    # displacement counts, so that equations weigh as their radius.
    powers = (t / t[-1]) ** [1, 2, 3]
    system = np.hstack([powers, -radial * powers])
    solution = np.linalg.lstsq(system * r, ((radial - 1) * r)[:, 0], rcond=1e-12)[0]
    a, b = solution.reshape(2, 3)
    fitted = (1 + powers @ a) / (1 + powers @ b)
    error = float(max(fx, fy) * (np.abs(fitted[:, None] - radial) * r).max())
    a, b = (each / t[-1] ** [1, 2, 3] for each in (a, b))
    params = (fx, fy, cx, cy, a[0], a[1], p1, p2, a[2], *b)
    return ("FULL_OPENCV", tuple(map(float, params))), error


def _approximated(errors: Sequence[float]) -> list[Finding]:
    if not errors:
        return []
    severity: Severity = "info" if max(errors) <= _MAX_ERROR else "warning"
    text = f"The terms of r^8 of {counted(len(errors), 'camera')}, which COLMAP's models lack, are"
    text += f" approximated by FULL_OPENCV within {max(errors):.2g} px."
    return [Finding("approximated-distortion", text, severity)]


def _disabled(names: Sequence[str]) -> list[Finding]:
    if not names:
        return []
    are = agreeing(len(names), "is disabled and", "are disabled and")
    text = f"{counted(len(names), 'photograph')} {are} left out, such as {names[0]}."
    return [Finding("disabled-cameras", text, "info", tuple(names))]


def ignored(term: str, pixels: float, what: str) -> Finding:
    """Report a term of distortion that no model of COLMAP has, by its largest displacement."""
    text = f"{term} of {what} is ignored, as COLMAP's models have no such term: it moves pixels"
    return Finding("ignored-distortion", f"{text} by up to {pixels:.2g} px.")


def points_of(
    xyz: Iterable[Sequence[float]], rgb: Iterable[Sequence[float]] | None, path: Path | None = None
) -> Points:
    """Return the points of lists in a file, grey if there are no colours (0 to 255)."""
    exact = np.array([*xyz], np.float64).reshape(-1, 3)
    colors = np.full(exact.shape, _GREY, np.uint8)
    if rgb is not None:
        stored = np.nan_to_num(np.array([*rgb], np.float64).reshape(-1, 3))
        colors = np.clip(stored, 0, 255).astype(np.uint8)
    with np.errstate(over="ignore"):  # beyond float32's range: infinite, dropped later
        return PointCloud(exact.astype(np.float32), colors), exact, path


def begins_with(folder: Path, pattern: str, *words: bytes, head: int = 4096) -> list[Path]:
    """List the files of a pattern in a folder whose beginnings have all of some words."""
    found = []
    for path in sorted(folder.glob(pattern)):
        if path.is_file() and not is_hidden(path.name):
            with open_file(path) as file:
                start = file.read(head)
            found += [path] if all(word in start for word in words) else []
    return found


def largest(files: Sequence[Path]) -> tuple[Path, list[Finding]]:
    """Return the largest of several exports, and name the others in a finding."""
    first, *others = sorted(files, key=lambda path: (-path.stat().st_size, path.name))
    if not others:
        return first, []
    names = ", ".join(path.name for path in others)
    text = f"{first.name} is read, the largest; {counted(len(others), 'other file')} of cameras"
    return first, [Finding("several-models", f"{text}: {names}.", fix="Pass a file to read it.")]


def read_export(parse: Callable[[Path], Export], path: Path, root: Path, what: str) -> Scene:
    """Read a file of cameras in a scene's folder; ``what`` it should be, for errors."""
    with translate_errors(path, what, fix=EXPORT_AGAIN):
        export = parse(path)
    return make_scene(export, root)


def make_scene(export: Export, root: Path) -> Scene:
    """Make the scene of an export in a folder.

    Raises:
        SceneNotFoundError: No shot has a pose, or none a photograph where lenses depend on it.
        SceneFormatError: A record is malformed, or most are not finite.
    """
    track, shots = export.track, export.shots
    if not shots:
        raise SceneNotFoundError(
            f"photographs with poses in {track}",
            found=f"{len(export.unposed) + len(export.disabled) or 'none'} without a pose",
            fix=EXPORT_AGAIN,
        )
    for shot in shots:
        check_record(_is_name(shot.name), "the name of a photograph", shot.where, repr(shot.name))
    names, ambiguous = [shot.name for shot in shots], set[str]()
    folder, files = export.folder, {name: name for name in names}
    if folder is None:
        folder, files, ambiguous = find_photographs(root, names)
    if folder and folder != root and folder.parent == root.absolute().parent:
        root = folder.parent  # the export lies in a folder beside the photographs
    used = _use_shots(export, Path(folder or root), files, ambiguous)
    images, unusable, lost = used.images, used.unusable, used.lost
    if not images and lost:
        raise SceneNotFoundError(
            f"the photographs of {track} in {root} or its folder images, such as {lost[0]}",
            found="none",
            fix="Copy them there.",
        )
    check_enough(unusable, len(images))
    points, found = _points(export, root)
    findings = (
        *export.findings,
        *_approximated(used.errors),
        *_disabled(export.disabled),
        *left_out("missing-poses", "photograph", "a pose", export.unposed),
        *left_out("missing-photographs", "photograph", "one file of that name", lost),
        *unusable_findings(unusable, len(images)),
        *_unlisted(folder, [*images], export),
        *photograph_findings([*images.values()], folder, root),
        *lens_findings([*images.values()]),
        *found,
    )
    cloud, exact, path = points
    source = SceneSource(
        export.program, root, path or track, image_dir=folder, convention=export.convention
    )
    absent = (*unusable, *lost)
    scene = Scene(
        cloud, tuple(images.values()), used.cameras, None, source, findings,
        absent=absent,
    )  # fmt: skip
    return recentered(scene, exact)


class _Used(NamedTuple):
    """The shots of an export that can be used, and why others cannot."""

    images: dict[str, Image]
    cameras: tuple[Intrinsics, ...]
    unusable: dict[str, NotFiniteError]
    lost: list[str]  # names without a photograph
    errors: list[float]  # of approximated lenses, px


def _use_shots(
    export: Export, folder: Path, files: Mapping[str, str], ambiguous: Collection[str]
) -> _Used:
    """Make the images and cameras of shots, whose photographs are ``files`` of a folder."""
    cameras: dict[tuple[Lens, Size], Intrinsics] = {}
    images, unusable, lost = dict[str, Image](), dict[str, NotFiniteError](), list[str]()
    errors = list[float]()  # of approximated lenses, px
    for i, shot in enumerate(export.shots):
        name = files.get(shot.name, "" if shot.name in ambiguous else _relative(shot.name))
        if not name or name in images or (shot.size is None and shot.name not in files):
            lost.append(shot.name)
            continue
        try:
            size = shot.size or photograph_size(folder / name)
            with translate_errors(export.track, "a file of cameras", fix=EXPORT_AGAIN):
                lens = shot.lens(size)
            if (lens, size) not in cameras:
                (model, params), error = _without_r8(shot.where, lens, size)
                errors += [error] if model != lens[0] else []
                camera_id = len(cameras) + 1
                cameras[lens, size] = make_intrinsics(shot.where, camera_id, model, *size, params)
            finite = bool(np.isfinite(shot.world_from_cam).all())
            require_finite(finite, "a finite pose", shot.where, "NaN or infinity")
            pose = rigid_pose(shot.where, shot.world_from_cam)
        except NotFiniteError as error:
            unusable[name] = error
            continue
        images[name] = Image(name, i + 1, cameras[lens, size], *pose)
    return _Used(images, tuple(cameras.values()), unusable, lost, errors)


def _points(export: Export, root: Path) -> tuple[Points, list[Finding]]:
    """Return an export's own points, else those of a PLY file beside it or in its scene."""
    if export.points is not None and len(export.points[0]):
        return export.points, []
    beside = [*export.track.parent.glob("*.ply"), *root.glob("*.ply")]
    plain = [path for path in dict.fromkeys(sorted(beside)) if not _holds(path, _GAUSSIANS)]
    path = first_with_points(plain)
    if path is None:
        return (PointCloud.empty(), np.empty((0, 3)), None), []
    cloud, exact = read_ply_float64(path)
    use = f"move {path.name} elsewhere"
    found = [each for other in plain for each in differing_points(path, exact, other, use)]
    return (cloud, exact, path), found


def _holds(path: Path, word: bytes) -> bool:
    with open_file(path) as file:
        return word in file.read(4096)


def find_photographs(
    root: Path, names: Sequence[str]
) -> tuple[Path | None, dict[str, str], set[str]]:
    """Find the folder of photographs: the first with half of them, else that with most.

    Returns:
        The folder, None if it has none; the paths in it, by name; names that fit several files, or
        a file that fits another name as well.
    """
    best: tuple[Path | None, dict[str, str], set[str]] = (None, {}, set())
    for folder in _folders(root, names):
        files, ambiguous = _matched(names, image_files(folder))
        if len(files) + len(ambiguous) > len(best[1]) + len(best[2]):
            best = (folder, files, ambiguous)
        if 2 * len(files) >= len({*names}):
            break
    return best


def image_files(folder: Path) -> list[str]:
    """Return the paths of the photographs in a folder and its subfolders, without masks."""
    names = [path.relative_to(folder).as_posix() for path in files_below(folder)]
    names = [name for name in names if _is_image(name)]
    return sorted({*names} - masks_among(names))


def _folders(root: Path, names: Sequence[str]) -> Iterable[Path]:
    """Yield the folders that may have the photographs, most likely first."""
    yield from (folder for name in IMAGE_DIRS if (folder := root / name).is_dir())
    stated = dict.fromkeys(Path(name).parent for name in names if Path(name).is_absolute())
    yield from (folder for folder in stated if folder.is_dir())
    inside = [path for path in sorted(root.iterdir()) if path.is_dir() and not is_hidden(path.name)]
    pictures = [p for p in inside if not any(w in p.name.casefold() for w in _NO_PHOTOGRAPHS)]
    yield from (path for path in pictures if path.name not in IMAGE_DIRS)
    above = root.absolute().parent
    yield from (folder for name in IMAGE_DIRS if (folder := above / name).is_dir())
    yield root


def _relative(name: str) -> str:
    """Return a name for an image whose photograph is missing."""
    parts = _parts(name)
    return parts[-1] if PureWindowsPath(name).anchor else "/".join(parts)


def _parts(name: str) -> tuple[str, ...]:
    """Return the parts of a path of any system."""
    pure = PureWindowsPath(name)
    parts = tuple(part for part in pure.parts if part not in {pure.anchor, "..", "."})
    return parts or (name,)


def _tails(name: str) -> list[str]:
    parts = _parts(name.casefold())
    return ["/".join(parts[start:]) for start in range(len(parts))]


def _matched(names: Sequence[str], files: Sequence[str]) -> tuple[dict[str, str], set[str]]:
    """Match names with files by the longest tail of the path, with suffix and then without."""
    whole, bare = dict[str, list[str]](), dict[str, list[str]]()
    for file in files:
        for tail in _tails(file):
            whole.setdefault(tail, []).append(file)
            bare.setdefault(PurePosixPath(tail).with_suffix("").as_posix(), []).append(file)
    matched, ambiguous = dict[str, tuple[str, int]](), set[str]()
    for name in dict.fromkeys(names):
        stem = PurePosixPath(name).with_suffix("").as_posix()
        bare_tails = [*_tails(name), *(_tails(stem) if _is_image(name) else [])]
        found, length = _first(whole, _tails(name)) or _first(bare, bare_tails) or ([], 0)
        if len(found) == 1:
            matched[name] = found[0], length
        elif found:
            ambiguous.add(name)
    # Of several names that fit a file, the one with the longest common path has it.
    repeated = Counter(names)
    claims = Counter(each for name, each in matched.items() for _ in range(repeated[name]))
    longest = dict(sorted(matched.values(), key=lambda each: each[1]))
    kept = dict[str, str]()
    for name, (file, length) in matched.items():
        if length == longest[file] and claims[file, length] == 1:
            kept[name] = file
    return kept, ambiguous | (matched.keys() - kept.keys())


def _is_name(name: object) -> bool:
    return isinstance(name, str) and bool(PurePosixPath(name).name)


def _is_image(name: str) -> bool:
    return PurePosixPath(name).suffix.lower() in IMAGE_SUFFIXES


def _first(index: Mapping[str, list[str]], tails: Iterable[str]) -> tuple[list[str], int] | None:
    """Return what an index has for the first tail that it has, and the tail's length."""
    return next(((index[tail], len(tail)) for tail in tails if tail in index), None)


def _unlisted(folder: Path | None, names: Sequence[str], export: Export) -> list[Finding]:
    """Report photographs beside those of the export that it does not have."""
    if folder is None or folder == export.folder:
        return []
    used = {*names}
    places = {PurePosixPath(name).parent for name in used}
    there = [file for file in image_files(folder) if PurePosixPath(file).parent in places]
    others = [name for name in (*export.unposed, *export.disabled) if _is_name(name)]
    without, doubtful = _matched(others, there)
    unlisted = [file for file in there if file not in used and file not in {*without.values()}]
    if doubtful:
        return []
    return left_out("missing-poses", "photograph", f"a record in {export.track.name}", unlisted)
