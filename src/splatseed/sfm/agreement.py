"""Compare a model's poses with the verified matches of its photographs.

Wrong poses can fit their own points, but not the matches that mapping left out: those of
photographs that it placed elsewhere. Few may be left out if two well-connected parts of a capture
are displaced against each other, so the weakest link between two parts counts besides the total.

Notation: a pair of photographs has t verified matches, of which a are explained by the poses.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.linalg import eigh

from splatseed.sfm.colmap import ColmapRun

_MAX_ERROR = 4.0  # px between a match and its epipolar line, as in COLMAP's verification of pairs
_PART = 0.05  # of the photographs in each of two parts at least; a few may look like others


class Agreement(NamedTuple):
    """How far a model's poses agree with the verified matches."""

    explained: float  # share of all matches
    link: float  # share of the matches between ``part`` and the rest; 1 if no two parts have any
    part: tuple[str, ...]  # names of the smaller part at the weakest link, sorted
    agreeing: tuple[tuple[str, str], ...]  # pairs that link the two, of mostly explained matches


class _Pairs(NamedTuple):
    """Pairs of photographs with a pose, by their position among the names."""

    names: list[str]
    first: Int64[np.ndarray, " P"]
    second: Int64[np.ndarray, " P"]
    matches: Float64[np.ndarray, " P"]  # t
    explained: Float64[np.ndarray, " P"]  # a


def compare_with_matches(run: ColmapRun, model: Any) -> Agreement:
    """Return how far a model's poses agree with the verified matches.

    A match is explained if its points are within ``_MAX_ERROR`` of their epipolar lines (Sampson's
    error). The matches of photographs without a pose are not.
    """
    pairs, unposed = _read_pairs(run, model)
    total = float(pairs.matches.sum()) + unposed
    share = float(pairs.explained.sum()) / max(total, 1.0)
    return Agreement(share, *_weakest_link(pairs))


def _read_pairs(run: ColmapRun, model: Any) -> tuple[_Pairs, int]:
    """Count the matches of pairs with poses, and those of pairs without."""
    pycolmap = run.pycolmap
    names: list[str] = []
    unposed, rows = 0, []
    with pycolmap.Database.open(run.database) as database:
        numbers, rays, limits, posed = {}, {}, {}, {}
        for image in database.read_all_images():
            found = model.find_image_with_name(image.name)
            if found is not None and found.has_pose:
                camera, keypoints = found.camera, database.read_keypoints(image.image_id)
                posed[image.image_id] = found.cam_from_world()
                rays[image.image_id] = camera.cam_from_img(keypoints[:, :2].astype(np.float64))
                limits[image.image_id] = camera.cam_from_img_threshold(_MAX_ERROR)
                numbers[image.image_id] = len(names)
                names.append(image.name)
        ids, geometries = database.read_two_view_geometries()
    for pair, geometry in zip(map(pycolmap.pair_id_to_image_pair, ids), geometries, strict=True):
        matches = geometry.inlier_matches
        if not len(matches):
            continue
        if not posed.keys() >= {*pair}:
            unposed += len(matches)
            continue
        a, b = pair
        essential = pycolmap.essential_matrix_from_pose(posed[b] * posed[a].inverse())
        squared = pycolmap.compute_squared_sampson_error(
            rays[a][matches[:, 0]], rays[b][matches[:, 1]], essential
        )
        near = np.count_nonzero(np.array(squared) < max(limits[a], limits[b]) ** 2)
        rows.append((numbers[a], numbers[b], len(matches), near))
    columns = np.array(rows, np.int64).reshape(-1, 4).T
    return _Pairs(names, columns[0], columns[1], *columns[2:].astype(float)), unposed


def _weakest_link(pairs: _Pairs) -> tuple[float, tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Return the smallest share of explained matches between two parts, the smaller and the links.

    Of all divisions of the photographs, the one that minimises sum a / sum t over the pairs that it
    separates is approximated as in spectral clustering: the smallest generalised eigenvector of the
    Laplacians of a and t orders the photographs, and all divisions of that order are tried (as in
    Shi and Malik, Normalized cuts and image segmentation, 2000, for the ratio of two graphs).
    """
    count = len(pairs.names)
    least = max(1, round(_PART * count))
    if count < 2 * least or not len(pairs.first):
        return 1.0, (), ()
    explained, matches = (
        _laplacian(pairs, weights) for weights in (pairs.explained, pairs.matches)
    )
    # The same for both keeps the constant vector, in whose direction both vanish, from the minimum.
    even = np.trace(matches) / count**2
    few = 1e-9 * np.trace(matches) / count * np.eye(count)  # for parts without matches
    _, vectors = eigh(explained + even + few, matches + even + few, subset_by_index=[0, 0])
    order = np.argsort(vectors[:, 0], kind="stable")
    place = np.empty(count, np.int64)
    place[order] = np.arange(count)
    ends = np.sort(place[[pairs.first, pairs.second]], axis=0)
    shares = np.ones(count)
    for size in range(least, count - least + 1):
        apart = (ends[0] < size) & (ends[1] >= size)
        if apart.any():
            shares[size] = pairs.explained[apart].sum() / pairs.matches[apart].sum()
    size = int(np.argmin(shares))
    part = order[:size] if 2 * size <= count else order[size:]
    apart = (ends[0] < size) & (ends[1] >= size)
    fitting = np.flatnonzero(apart & (2 * pairs.explained >= pairs.matches))
    links = ((pairs.names[pairs.first[i]], pairs.names[pairs.second[i]]) for i in fitting)
    return float(shares[size]), tuple(sorted(pairs.names[i] for i in part)), tuple(links)


def _laplacian(pairs: _Pairs, weights: Float64[np.ndarray, " P"]) -> Float64[np.ndarray, "N N"]:
    count = len(pairs.names)
    adjacent = np.zeros((count, count))
    np.add.at(adjacent, (pairs.first, pairs.second), weights)
    adjacent += adjacent.T
    laplacian: Float64[np.ndarray, "N N"] = np.diag(adjacent.sum(axis=1)) - adjacent
    return laplacian
