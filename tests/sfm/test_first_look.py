"""Pairs of photographs by a first look: what is counted, and which pairs follow from it."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from splatseed.progress import silent, thread_limit
from splatseed.sfm import Settings, first_look, matching
from splatseed.sfm.colmap import ColmapRun, posed_model, require_pycolmap
from splatseed.sfm.database import run_database
from splatseed.sfm.first_look import (
    FIRST_LOOK,
    choose_pairs,
    further_pairs,
    largest_features,
    measure_agreement,
    poorly_connected,
)
from splatseed.sfm.mapping import map_images


def descriptors(rng, number):
    """SIFT-like: non-negative, of norm 512 as integers."""
    values = rng.gamma(0.3, size=(number, 128))
    values *= 512 / np.linalg.norm(values, axis=1, keepdims=True)
    return values.round().clip(0, 255).astype(np.uint8)


def slow_agreement(one, other):
    """COLMAP's tests for a pair, feature by feature."""
    cosines = one.astype(np.float64) @ other.T.astype(np.float64) / 512**2
    angles = np.arccos(cosines.clip(-1, 1))
    count = 0
    for i, row in enumerate(angles):
        j = row.argmin()
        second = np.delete(row, j).min()
        mutual = angles[:, j].argmin() == i
        count += mutual and row[j] < 0.7 and row[j] < 0.8 * second
    return count


def test_agreement_is_the_number_of_mutual_matches_whatever_the_threads():
    rng = np.random.default_rng(0)
    scene = descriptors(rng, 66)
    photographs = np.zeros((7, 40, 128), np.uint8)
    for i, photograph in enumerate(photographs):  # a window that moves over the scene, with noise
        seen = scene[5 * i : 5 * i + 36].astype(int)  # the last four rows stay empty
        photograph[:36] = (seen + rng.integers(-9, 10, seen.shape) * (seen > 9)).clip(0, 255)
    found = measure_agreement(photographs)
    assert found[0, 1] > 25
    assert found[0, 6] > 3
    for i in range(7):
        for j in range(i):
            assert found[i, j] == found[j, i] == slow_agreement(photographs[i], photographs[j])
    assert not found.diagonal().any()
    limit = thread_limit.set(1)
    np.testing.assert_array_equal(measure_agreement(photographs), found)
    thread_limit.reset(limit)


def walk(number, *, turns=2, reach=25):
    """Agreement along a walk of several rounds: of neighbours in time, and less between rounds."""
    time = np.arange(number)
    ahead = np.abs(time[:, None] - time)
    beside = np.abs(
        (time[:, None] - time + number / turns / 2) % (number / turns) - number / turns / 2
    )
    seen = np.maximum(200 * (1 - ahead / reach), 20 * (1 - beside / 3)).clip(0)
    return np.where(ahead == 0, 0, seen).astype(np.int32)


def parts(number, pairs):
    rows, columns = np.array(sorted(pairs)).T
    graph = coo_array((np.ones(len(rows)), (rows, columns)), (number, number))
    return connected_components(graph, directed=False)[0]


def test_pairs_are_few_and_close_loops():
    pairs = choose_pairs(walk(200))
    assert pairs == sorted({*pairs})
    assert len(pairs) < 200 * 20 / 2
    partners = np.bincount(np.ravel(pairs), minlength=200)
    assert partners.min() >= FIRST_LOOK.partners
    of_few = np.bincount(np.ravel(choose_pairs(walk(60))))
    assert of_few.min() >= FIRST_LOOK.max_partners
    between_rounds = [pair for pair in pairs if pair[1] - pair[0] > 30]
    assert {i for i, _ in between_rounds} >= set(range(5, 95))


def test_photographs_that_agree_with_none_are_matched_with_their_successors():
    assert choose_pairs(np.zeros((40, 40), np.int32)) == [
        (i, j) for i in range(40) for j in (i + 1, i + 2) if j < 40
    ]


def test_few_photographs_are_matched_exhaustively():
    number = FIRST_LOOK.max_exhaustive
    assert len(choose_pairs(np.zeros((number, number), np.int32))) == number * (number - 1) // 2


def test_weak_connections_are_found_and_get_the_next_partners():
    agreement = walk(60, turns=1)
    pairs = choose_pairs(agreement)
    verified = {(i, j): 100 if (i < 40) == (j < 40) else 20 for i, j in pairs}
    assert poorly_connected(60, verified) == list(range(40, 60))  # the smaller part
    verified |= {pair: 5 for pair in pairs if 7 in pair}
    assert poorly_connected(60, verified) == [7, *range(40, 60)]
    further = further_pairs(agreement, [7], pairs)
    assert not {*further} & {*pairs}
    assert all(7 in pair for pair in further)
    assert {(7, j) for j in range(8, 32)} <= {*further, *pairs}  # all that it agrees with
    assert len(further_pairs(np.full((90, 90), 9), [0], ())) == FIRST_LOOK.further


@pytest.fixture
def run(room, tmp_path):
    """A run on eight photographs of the room, and their model."""
    shutil.copytree(room.source.image_dir, tmp_path / "photos")
    work = tmp_path / "work"
    work.mkdir()
    run = ColmapRun(require_pycolmap(), Settings(threads=2), tmp_path / "photos", work, silent)
    return run, posed_model(run.pycolmap, room.images[:8])


def test_the_largest_features_are_read(run):
    run, model = run
    with run_database(run, model) as database:
        matching.detect_features(run, database, model)
        (features,) = largest_features(database, [3])
        keypoints, all_features = database.read_keypoints(3), database.read_descriptors(3).data
        scales = np.hypot(keypoints[:, 2], keypoints[:, 4])
        order = np.argsort(-scales, kind="stable")
        seen = {row.tobytes() for row in features}
        assert {row.tobytes() for row in all_features[order[:200]]} <= seen
        assert not {row.tobytes() for row in all_features[order[300:]]} & seen


def test_a_graph_in_parts_is_completed_before_and_after_mapping(run, monkeypatch):
    """Two halves, joined by further pairs; then photographs without a pose."""
    run, model = run
    names = [model.image(i).name for i in range(1, 9)]
    few = replace(
        FIRST_LOOK,
        partners=2,
        max_partners=2,
        bridges=0,
        successors=0,
        max_exhaustive=4,
        min_connections=0,
    )
    for module in (first_look, matching):
        monkeypatch.setattr(module, "FIRST_LOOK", few)
    halves = np.zeros((8, 8), np.int32)
    halves[:4, :4] = halves[4:, 4:] = 9
    halves[3, 4] = halves[4, 3] = 3
    np.fill_diagonal(halves, 0)
    monkeypatch.setattr(matching, "measure_agreement", lambda *_: halves)
    agreement = matching.match_photographs(run, model)
    with run.pycolmap.Database.open(run.database) as database:
        pairs = map(
            run.pycolmap.pair_id_to_image_pair, database.read_two_view_geometry_num_inliers()[0]
        )
        assert (4, 5) in set(pairs)  # joins them
        for i in range(1, 5):
            for j in range(5, 9):
                if database.exists_two_view_geometry(i, j):
                    database.delete_two_view_geometry(i, j)
    halves[halves == 0] = 1
    asked = []

    def further(lost):
        asked.append(lost)
        return matching.match_further(run, agreement, lost)

    folder, _ = map_images(run, names, "PINHOLE", further, partial=False)
    assert asked == [names[:4]] or asked == [names[4:]]
    assert run.pycolmap.Reconstruction(folder).num_reg_images() == 8
    assert list(run.seconds)[-4:] == ["matching", "further matching", "mapping", "further mapping"]
