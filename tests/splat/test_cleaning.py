"""Gaussians that no renderer can draw are left out, in every format, and counted."""

from __future__ import annotations

import dataclasses
import gzip
import json
import zipfile

import numpy as np
import pytest

from splatseed.errors import SceneFormatError
from splatseed.splat.formats import WRITTEN_SUFFIXES, read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians

from .compressed import write_any

SUFFIXES = [".compressed.ply", *WRITTEN_SUFFIXES]
BAD = [
    *((name, value) for name in ("means", "quats", "sh0", "shN") for value in (np.nan, -np.inf)),
    *(("scales", value) for value in (np.nan, np.inf, 89.0)),  # e^89 is beyond float32
    ("opacities", np.nan),
]
WORDS = {
    "means": "position", "scales": "size", "quats": "rotation", "opacities": "opacity",
    "sh0": "colour", "shN": "colour",
}  # fmt: skip


@pytest.fixture(scope="module")
def model():
    rng = np.random.default_rng(3)
    arrays = {
        "means": rng.normal(size=(40, 3)),
        "scales": rng.normal(size=(40, 3)) - 4,
        "quats": rng.normal(size=(40, 4)),
        "opacities": rng.normal(size=40),
        "sh0": rng.uniform(-1, 1, (40, 1, 3)),
        "shN": 0.1 * rng.normal(size=(40, 3, 3)),
    }
    return Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})


def _with(model, name, rows, value):
    array = getattr(model, name).copy()
    array.reshape(len(array), -1)[rows, -1] = value
    return dataclasses.replace(model, **{name: array})


def _read(path):
    notes = []
    return read_gaussians(path, lambda finding: notes.append(str(finding))), notes


@pytest.mark.parametrize(("name", "value"), BAD)
def test_gaussians_with_unusable_numbers_are_dropped(model, name, value, tmp_path):
    write_gaussians(tmp_path / "m.ply", _with(model, name, [5], value))
    kept, notes = _read(tmp_path / "m.ply")
    assert np.array_equal(kept.means, np.delete(model.means, 5, axis=0))
    assert len(notes) == 1
    assert (
        f"1 Gaussian of 40 in {tmp_path / 'm.ply'} has no usable {WORDS[name]} and was" in notes[0]
    )
    for suffix in SUFFIXES:  # and so of every file made from it
        write_any(tmp_path / f"out{suffix}", kept)
        again, notes = _read(tmp_path / f"out{suffix}")
        assert (len(again), notes) == (39, [])
        assert all(np.isfinite(array).all() for array in again.arrays().values())


def test_unusable_gaussians_are_counted_by_kind_and_a_model_of_them_alone_is_refused(
    model, tmp_path
):
    bad = _with(_with(model, "means", [1, 2, 3], np.nan), "quats", [3, 4], np.inf)
    write_gaussians(tmp_path / "m.ply", bad)
    kept, (note,) = _read(tmp_path / "m.ply")
    assert len(kept) == 36
    assert "4 Gaussians of 40" in note
    assert "have no usable position (3), rotation (2) and were left out" in note
    write_gaussians(tmp_path / "m.ply", _with(model, "scales", slice(None), np.nan))
    with pytest.raises(SceneFormatError, match="40 Gaussians without a usable size"):
        read_gaussians(tmp_path / "m.ply")


def test_opacities_of_0_and_1_sizes_of_0_and_rotations_of_a_sphere_are_kept(model, tmp_path):
    odd = _with(_with(model, "opacities", [0], np.inf), "opacities", [1], -np.inf)
    odd = _with(odd, "scales", [2], -np.inf)
    scales = odd.scales.copy()
    scales[3] = -4.0  # round
    quats = model.quats.copy()
    quats[3:5] = 0.0  # of a ball, which may have it, and of another
    quats[6] *= 1e-30  # the square underflows
    odd = dataclasses.replace(odd, quats=quats, scales=scales)
    write_gaussians(tmp_path / "m.ply", odd)
    kept, (note,) = _read(tmp_path / "m.ply")
    assert "1 Gaussian of 40" in note
    assert "rotation" in note
    assert np.array_equal(kept.means, np.delete(model.means, 4, axis=0))
    assert kept.opacities[:2].tolist() == [np.inf, -np.inf]
    assert np.isfinite(kept.scales).all()
    assert np.exp(kept.scales[2, 2]) < 1e-37
    assert kept.quats[3].tolist() == [1, 0, 0, 0]
    unit = model.quats[6] / np.linalg.norm(model.quats[6])
    np.testing.assert_allclose(kept.quats[5], unit, atol=1e-6)


def test_non_finite_gaussians_of_packed_files_are_dropped(model, tmp_path):
    """Other writers put a NaN into a record, a chunk's bounds, a half float or a codebook."""
    for suffix in SUFFIXES:
        write_any(tmp_path / f"m{suffix}", model)
    content = {suffix: bytearray((tmp_path / f"m{suffix}").read_bytes()) for suffix in SUFFIXES}
    nan = np.float32(np.nan).tobytes()
    splat = content[".splat"]
    splat[7 * 32 : 7 * 32 + 4] = nan  # a position
    splat[9 * 32 + 12 : 9 * 32 + 16] = np.float32(-1).tobytes()  # a scale that has no logarithm
    (tmp_path / "m.splat").write_bytes(splat)
    kept, (note,) = _read(tmp_path / "m.splat")
    assert len(kept) == 38
    assert "position (1), size (1)" in note
    two = content[".compressed.ply"]  # the bound of a chunk
    start = two.index(b"end_header\n") + 11
    two[start : start + 4] = nan
    (tmp_path / "m.compressed.ply").write_bytes(two)
    with pytest.raises(SceneFormatError, match="40 Gaussians without a usable position"):
        read_gaussians(tmp_path / "m.compressed.ply")
    halves = np.zeros((2, 3), "<f2")
    halves[1, 2] = np.inf
    rest = bytes([200] * 2) + bytes([128] * 6) + bytes([100] * 6) + bytes([128] * 6)
    header = b"NGSP" + np.array([1, 2], "<u4").tobytes() + bytes([0, 0, 0, 0])
    (tmp_path / "old.spz").write_bytes(gzip.compress(header + halves.tobytes() + rest))
    kept, (note,) = _read(tmp_path / "old.spz")
    assert (len(kept), "position" in note) == (1, True)
    with zipfile.ZipFile(tmp_path / "m.sog") as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(parts["meta.json"])
    meta["scales"]["codebook"][-1] = float("nan")  # which one of the largest sizes is
    parts["meta.json"] = json.dumps(meta).encode()
    with zipfile.ZipFile(tmp_path / "m.sog", "w") as archive:
        for name, data in parts.items():
            archive.writestr(name, data)
    kept, (note,) = _read(tmp_path / "m.sog")
    assert (len(kept), "size" in note) == (39, True)
