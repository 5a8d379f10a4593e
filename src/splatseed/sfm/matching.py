"""Features of photographs, and their verified matches, in the database of a run.

Notation: a ``model`` is a ``pycolmap.Reconstruction``, a ``database`` a ``pycolmap.Database``. A
pair is two image ids. Promise: the matches of a pair depend neither on other pairs nor on threads.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from splatseed.errors import SceneFormatError
from splatseed.io.masks import write_masks
from splatseed.scene import Image, Masks
from splatseed.sfm.colmap import ColmapRun
from splatseed.sfm.database import numbered, run_database
from splatseed.sfm.first_look import (
    FIRST_LOOK,
    NEIGHBOURS,
    STAGE,
    Agreement,
    Pair,
    choose_pairs,
    further_pairs,
    largest_features,
    measure_agreement,
    poorly_connected,
)
from splatseed.sfm.photos import COPIES, copy_misread
from splatseed.text import name_some, numeric_order

_STEPS = sorted({*range(1, 11), *(2**n for n in range(10))})
"""How far on in the sequence partners are: COLMAP's overlap of 10, and powers of two."""
_BLOCK_PAIRS = 128
"""Matches are committed per block of as many pairs; as many photographs' features are in memory."""


def match_photographs(
    run: ColmapRun, model: Any, masks: Masks | None = None, poses: Sequence[Image] = ()
) -> Agreement | None:
    """Fill the database with a model's images, features and verified matches.

    ``poses``, if they are known, are the model's images in the order of their ids, from 1.

    Returns the agreement of photographs at a first look, if that chose the pairs; for known poses
    with the agreement to be expected from their overlap added, and 0 without overlap.
    """
    with run_database(run, model) as database:
        detect_features(run, database, model, masks)
        if run.settings.matcher != "auto" or len(model.images) <= FIRST_LOOK.max_exhaustive:
            match_pairs(run, database, _pairs(run, database))
            return None
        ids = sorted(model.images)
        started = time.perf_counter()
        features = largest_features(database, ids)
        agreement = measure_agreement(features, run.on_progress)
        frames = [model.image(image_id).frame_id for image_id in ids]
        agreement = agreement * np.not_equal.outer(frames, frames)
        run.seconds[STAGE] = time.perf_counter() - started
        if poses:
            expected = _expected_agreement(run, database, model, poses)
            # Features of places that look alike agree, too.
            agreement = (agreement + expected) * (expected > 0)
        match_pairs(run, database, [(ids[i], ids[j]) for i, j in choose_pairs(agreement)])
        weak = poorly_connected(len(ids), _verified(run, database, ids))
        _match_further(run, database, agreement, weak)
    return agreement


def _expected_agreement(
    run: ColmapRun, database: Any, model: Any, poses: Sequence[Image]
) -> Agreement:
    """Infer the agreement from poses, and from depths by the matches of neighbours.

    It suffers from errors of the poses, but not from bare surfaces.
    """
    from splatseed.sfm import overlap  # noqa: PLC0415  (imports Numba, for which --help would wait)

    cameras = [image.camera for image in poses]
    pairs = overlap.first_pairs(cameras)
    match_pairs(run, database, [(i + 1, j + 1) for i, j in pairs], NEIGHBOURS)
    ids = range(1, len(poses) + 1)
    lenses = [model.image(i).camera for i in ids]
    xy = [database.read_keypoints(i)[:, :2].astype(np.float64) for i in ids]
    rays = [lens.cam_from_img(points) for lens, points in zip(lenses, xy, strict=True)]
    seen = [[np.empty((0, 3))] for _ in poses]
    for i, j in pairs:
        found = database.read_two_view_geometry(i + 1, j + 1)
        if not run.pycolmap.estimate_two_view_geometry_pose(
            *(lenses[i], xy[i], lenses[j], xy[j], found)
        ):
            continue  # unrelated
        matched = rays[i][found.inlier_matches[:, 0]], rays[j][found.inlier_matches[:, 1]]
        relative = found.cam2_from_cam1.matrix()
        points = overlap.points_of_matches(matched, relative, (cameras[i], cameras[j]))
        for view, of_view in zip((i, j), points, strict=True):
            seen[view].append(of_view)
    shares = overlap.overlaps(cameras, [np.concatenate(points) for points in seen])
    return overlap.expected_agreement(shares)


def match_further(run: ColmapRun, agreement: Agreement, names: Collection[str]) -> bool:
    """Match further pairs of photographs that got no pose; return whether any was verified."""
    with run.pycolmap.Database.open(run.database) as database:
        images = sorted(database.read_all_images(), key=lambda image: image.image_id)
        lost = [i for i, image in enumerate(images) if image.name in names]
        return _match_further(run, database, agreement, lost)


def _match_further(
    run: ColmapRun, database: Any, agreement: Agreement, photographs: Iterable[int]
) -> bool:
    ids = sorted(image.image_id for image in database.read_all_images())
    before = _verified(run, database, ids)
    if pairs := further_pairs(agreement, photographs, before):
        match_pairs(run, database, [(ids[i], ids[j]) for i, j in pairs], "further matching")
    after = _verified(run, database, ids)
    return any(after[pair] > 0 for pair in after.keys() - before)


def _verified(run: ColmapRun, database: Any, ids: Sequence[int]) -> dict[Pair, int]:
    index = {image_id: i for i, image_id in enumerate(ids)}
    pairs, counts = database.read_two_view_geometry_num_inliers()
    of_id = run.pycolmap.pair_id_to_image_pair
    return {
        (index[min(pair)], index[max(pair)]): count
        for pair, count in zip(map(of_id, pairs), counts, strict=True)
    }


def _pairs(run: ColmapRun, database: Any) -> list[Pair]:
    if run.settings.matcher == "sequential":
        images = sorted(database.read_all_images(), key=lambda image: numeric_order(image.name))
        ids = [image.image_id for image in images]
        return [(a, ids[i + n]) for i, a in enumerate(ids) for n in _STEPS if i + n < len(ids)]
    options = run.pycolmap.ExhaustivePairingOptions()
    return list(dict.fromkeys(run.pycolmap.ExhaustivePairGenerator(options, database).all_pairs()))


def detect_features(run: ColmapRun, database: Any, model: Any, masks: Masks | None = None) -> None:
    """Write the features of a model's images to the database, as far as they are missing."""
    pycolmap, settings = run.pycolmap, run.settings
    names = {image_id: image.name for image_id, image in sorted(model.images.items())}
    folder = run.work / "masks"
    if masks is not None:  # transparent pixels have no features
        masks = replace(masks, alpha=True)
    write_masks(masks, run.image_dir, names.values(), folder)
    copy_misread(run.image_dir, names.values(), run.work / COPIES)
    masked = {"mask_path": str(folder)} if folder.is_dir() else {}
    extraction = pycolmap.FeatureExtractionOptions(
        max_image_size=settings.max_image_size,
        num_threads=settings.threads,
        sift={"first_octave": -1 if settings.doubled else 0},
    )
    run.stage(
        "features",
        lambda: pycolmap.extract_features(
            *(run.database, run.readable, list(names.values())),
            reader_options=pycolmap.ImageReaderOptions(**masked),
            extraction_options=extraction,
            device=getattr(pycolmap.Device, settings.device),
        ),
        lambda: sum(map(database.exists_keypoints, names)),
        len(names),
    )
    skipped = [name for i, name in names.items() if not database.exists_keypoints(i)]
    if skipped:
        raise SceneFormatError(
            f"pycolmap to read all images of {run.image_dir}",
            found=f"{len(skipped)} that it skipped: {name_some(skipped)}",
            fix="Export them again as 8-bit JPEG or PNG, or remove them.",
        )


def match_pairs(
    run: ColmapRun, database: Any, pairs: Sequence[Pair], stage: str = "matching"
) -> None:
    """Match and verify distinct pairs of images whose features are in the database.

    Pairs with matches from before are skipped. May be called again for further pairs, if each call
    has a ``stage`` of its own.
    """
    pycolmap, settings = run.pycolmap, run.settings
    frames = {image.image_id: image.frame_id for image in database.read_all_images()}
    pairs = [(a, b) for a, b in pairs if frames[a] != frames[b]]  # no parallax within a panorama
    listed = run.work / "pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in pairs), "ascii")
    matched = sum(database.exists_matches(*pair) for pair in pairs)
    others = database.num_matched_image_pairs() - matched
    with numbered(database):
        run.stage(
            stage,
            lambda: pycolmap.match_image_pairs(
                run.database,
                matching_options=pycolmap.FeatureMatchingOptions(num_threads=settings.threads),
                pairing_options=pycolmap.ImportedPairingOptions(
                    match_list_path=listed, block_size=_BLOCK_PAIRS
                ),
                verification_options=pycolmap.TwoViewGeometryOptions(
                    ransac={"random_seed": settings.seed}
                ),
                device=getattr(pycolmap.Device, settings.device),
            ),
            lambda: database.num_matched_image_pairs() - others,
            len(pairs),
        )
