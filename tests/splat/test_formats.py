"""Models survive each format and agree with the formats' own tools; damaged files are refused."""

from __future__ import annotations

import gzip
import json
import os
import shutil
import struct
import subprocess
import zipfile
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.camera import rotation_from_quat
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError, SplatseedError
from splatseed.splat.formats import WRITTEN_SUFFIXES, read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.sog import _MAX_META
from splatseed.splat.spz import axis_signs

from .compressed import encode, write_any

SUFFIXES = [".compressed.ply", *WRITTEN_SUFFIXES]
# Of positions, log-scales, degrees of rotation, opacities, first and further coefficients.
LIMITS = {
    ".ply": (0, 0, 0, 0, 0, 0),
    ".compressed.ply": (0.02, 0.01, 0.3, 0.003, 0.02, 0.02),
    ".splat": (0, 1e-5, 0.8, 0.003, 0.01, None),
    ".spz": (1e-4, 0.04, 0.3, 0.003, 0.02, 0.02),
    ".sog": (0.002, 0.04, 1.0, 0.003, 0.03, 0.35),
}
"""The palette of .sog has a thousand entries for a thousand Gaussians here, of random colours."""


def _gaussians(count=700, rest=15, seed=0):
    rng = np.random.default_rng(seed)
    arrays = {
        "means": 3 * rng.normal(size=(count, 3)),
        "scales": rng.normal(size=(count, 3)) - 4,
        "quats": rng.normal(size=(count, 4)),
        "opacities": 2 * rng.normal(size=count),
        "sh0": rng.uniform(-1.7, 1.7, (count, 1, 3)),
        "shN": 0.1 * rng.normal(size=(count, rest, 3)),
    }
    return Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})


def _unit(quats):
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _assert_close(model, truth, limits):
    """Whatever order the Gaussians came back in: positions tell which is which."""
    nearest = np.argmin(((model.means[:, None] - truth.means[None]) ** 2).sum(axis=2), axis=1)
    assert sorted(nearest) == list(range(len(truth)))
    dots = np.abs((_unit(model.quats) * _unit(truth.quats[nearest])).sum(axis=1))
    degrees = np.rad2deg(2 * np.arccos(np.clip(dots, 0, 1)))
    opacity, true_opacity = (1 / (1 + np.exp(-g.opacities)) for g in (model, truth))
    errors = (
        np.abs(model.means - truth.means[nearest]).max(),
        np.abs(model.scales - truth.scales[nearest]).max(),
        degrees.max() - 0.09,  # what single precision makes of equal rotations
        np.abs(opacity - true_opacity[nearest]).max(),
        np.abs(model.sh0 - truth.sh0[nearest]).max(),
    )
    assert all(np.array(errors) <= limits[:5]), errors
    if limits[5] is None:
        assert model.shN.shape[1] == 0
    else:
        assert np.abs(model.shN - truth.shN[nearest]).max(initial=0) <= limits[5]


@pytest.mark.parametrize("rest", [0, 3, 8, 15])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_formats_round_trip_within_their_precision(suffix, rest, tmp_path):
    truth = _gaussians(rest=rest)
    write_any(tmp_path / f"m{suffix}", truth)
    content = (tmp_path / f"m{suffix}").read_bytes()
    write_any(tmp_path / f"m{suffix}", truth)
    assert (tmp_path / f"m{suffix}").read_bytes() == content
    (tmp_path / f"m{suffix}").rename(tmp_path / "m.splat")  # the content says what a file is
    model = read_gaussians(tmp_path / "m.splat")
    assert all(array.dtype == np.float32 for array in model.arrays().values())
    _assert_close(model, truth, LIMITS[suffix])
    if suffix == ".ply":
        for name, array in model.arrays().items():
            assert array.tobytes() == getattr(truth, name).tobytes(), name


def test_a_ply_has_the_layout_of_3dgs(tmp_path):
    model = _gaussians(2)
    write_gaussians(tmp_path / "g.ply", model)
    header, body = (tmp_path / "g.ply").read_bytes().split(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.splitlines() if b"property" in line]
    assert names == (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(45)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
    row = np.frombuffer(body, "<f4").reshape(2, 62)[1]
    assert np.array_equal(row[9:24], model.shN[1, :, 0])  # all of red first
    assert np.array_equal(row[58:], model.quats[1])


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_single_equal_and_distant_gaussians_round_trip(suffix, tmp_path):
    path, one, near = tmp_path / f"m{suffix}", _gaussians(1), _gaussians()
    write_any(path, one)
    assert len(read_gaussians(path)) == 1
    write_any(path, one.select(np.zeros(300, int)))
    np.testing.assert_allclose(read_gaussians(path).means, one.means.repeat(300, 0), atol=1e-3)
    far = replace(near, means=near.means + np.float32(1e4))
    write_any(path, far)
    found = np.sort(read_gaussians(path).means, axis=0)
    np.testing.assert_allclose(found, np.sort(far.means, axis=0), atol=0.02)


def test_a_compressed_ply_is_not_written(tmp_path):
    with pytest.raises(ParameterError, match=r"\.sog") as caught:
        write_gaussians(tmp_path / "m.compressed.ply", _gaussians())
    assert caught.value.found == ".compressed.ply, which is only read"
    assert not list(tmp_path.iterdir())


def test_fillers_of_a_compressed_ply_are_dropped(tmp_path):
    """Older versions padded chunks: the minimum of each bound, no rotation, opacity 0."""
    content = bytearray(encode(_gaussians(300, rest=0)))
    words = np.frombuffer(content, "<u4", offset=len(content) - 300 * 16).reshape(300, 4)
    words[200:256] = [0, 0x20080200, 0, 0]
    (tmp_path / "m.compressed.ply").write_bytes(content)
    assert len(read_gaussians(tmp_path / "m.compressed.ply")) == 300 - 56


def test_values_out_of_range_are_refused_or_leave_the_others_intact(tmp_path):
    near = _gaussians()
    with pytest.raises(ParameterError, match="of the origin"):
        write_gaussians(tmp_path / "m.spz", replace(near, means=near.means + np.float32(9e6)))
    scales = near.scales.copy()
    scales[5, 0] = -np.inf
    write_gaussians(tmp_path / "m.sog", replace(near, scales=scales))
    assert np.isfinite(read_gaussians(tmp_path / "m.sog").scales).all()


def test_opacities_of_0_and_1_stay_finite(tmp_path):
    sure = replace(_gaussians(), opacities=np.full(700, np.inf, np.float32))
    for suffix in SUFFIXES[:1] + SUFFIXES[2:]:
        write_any(tmp_path / f"m{suffix}", sure)
        opacities = read_gaussians(tmp_path / f"m{suffix}").opacities
        assert (np.isfinite(opacities) & (opacities > 5)).all()


# Damage ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A small model in each format, as bytes."""
    folder = tmp_path_factory.mktemp("models")
    for suffix in SUFFIXES:
        write_any(folder / f"m{suffix}", _gaussians(300))
    return {suffix: (folder / f"m{suffix}").read_bytes() for suffix in SUFFIXES}


@given(st.sampled_from(SUFFIXES), st.data())
@settings(max_examples=80, deadline=None)
def test_damaged_files_raise_one_error_or_are_read(files, tmp_path_factory, suffix, data):
    """Cut short or with bytes changed: our error or a model, nothing else."""
    content = bytearray(files[suffix])
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    for _ in range(data.draw(st.integers(1, 4)) if content else 0):
        most = data.draw(st.sampled_from([60, 2000, 10**9]))  # headers are where it hurts
        at = data.draw(st.integers(0, min(len(content) - 1, most)))
        content[at] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("damaged") / f"m{suffix}"
    path.write_bytes(content)
    with suppress(SplatseedError):
        assert len(read_gaussians(path)) > 0


def test_files_without_a_model_are_refused(files, tmp_path):
    bare = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nend_header\n"
    many = bytearray(gzip.decompress(files[".spz"]))
    many[8:12] = b"\xff\xff\xff\x7f"
    turned = bytearray(files[".spz"])
    turned[len(turned) // 3] ^= 255  # what is unpacked may be longer
    broken = replace(_gaussians(9), opacities=np.full(9, np.nan, np.float32))
    write_gaussians(tmp_path / "nan.ply", broken)
    for name, content, word in (
        ("a.spz", b"", "an empty file"),
        ("a.splat", bytes(33), "33 bytes"),
        ("a.ksplat", bytes(40), "splat-transform IN.ksplat"),
        ("a.glb", b"glTF\x02\0\0\0", r"\.glb"),
        ("metrics.json", b'{"psnr": 20.0}', "without Gaussians"),
        *((f"cut{suffix}", files[suffix][:-7], "cut") for suffix in SUFFIXES),
        ("m.ply", files[".compressed.ply"].replace(b" min_g", b" mim_g"), "min_g"),
        ("many.spz", gzip.compress(bytes(many)), "memory|ends"),
        ("turned.spz", bytes(turned), "turned.spz"),
        ("b.ply", files[".ply"].replace(b"f_dc_1", b"f_dc_9"), "f_dc_1"),
        ("c.ply", bare + bytes(4), "trained Gaussians"),
        ("nan.ply", (tmp_path / "nan.ply").read_bytes(), "9 Gaussians without a usable opacity"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(SplatseedError, match=word):
            read_gaussians(tmp_path / name)


def test_an_oversized_meta_json_is_refused_unread(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "m.sog", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("meta.json", b" " * (_MAX_META + 1))
    monkeypatch.setattr(zipfile.ZipFile, "read", None)  # must not be called
    with pytest.raises(SceneFormatError, match=r"meta\.json of 16,777,217 bytes"):
        read_gaussians(tmp_path / "m.sog")


def test_an_unpacked_sog_is_read(files, tmp_path):
    (tmp_path / "m.sog").write_bytes(files[".sog"])
    zipfile.ZipFile(tmp_path / "m.sog").extractall(tmp_path)
    assert json.loads((tmp_path / "meta.json").read_text())["version"] == 2
    assert len(read_gaussians(tmp_path / "meta.json")) == 300
    (tmp_path / "quats.webp").unlink()
    with pytest.raises(SceneNotFoundError, match=r"quats\.webp"):
        read_gaussians(tmp_path / "meta.json")


# Crop and clean ----------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [3, 4])
def test_axes_named_in_an_spz_are_converted(version, tmp_path):
    """SPZ_ADOBE_coordinate_system, after another extension."""
    pytest.importorskip("torch", reason="rotating harmonics needs PyTorch")
    from splatseed.rendering.harmonics import sh_basis

    truth = _gaussians()
    write_gaussians(tmp_path / "m.spz", truth)
    content = bytearray(gzip.decompress((tmp_path / "m.spz").read_bytes()))
    upright, content[14] = read_gaussians(tmp_path / "m.spz"), 2  # the flag of extensions

    def read_as(axes):
        records = struct.pack("<IIB", 0xADBE0002, 1, 5) + struct.pack("<III", 0xADBE0003, 4, axes)
        file = gzip.compress(bytes(content) + records)
        if version == 4:
            zstandard = pytest.importorskip("zstandard", reason="version 4 needs zstandard")
            sizes, at, table, streams = (9, 1, 3, 3, 4, 45), 16, b"", b""
            for size in (size * len(truth) for size in sizes):
                stream = zstandard.compress(bytes(content[at : at + size]))
                table += struct.pack("<QQ", len(stream), size)
                streams, at = streams + stream, at + size
            header = bytes(content[:4]) + struct.pack("<I", 4) + bytes(content[8:16])
            file = header + struct.pack("<I12x", 32 + len(records)) + records + table + streams
        (tmp_path / "m.spz").write_bytes(file)
        return read_gaussians(tmp_path / "m.spz")

    def covariances(model):
        rotations = np.stack([rotation_from_quat(quat) for quat in _unit(model.quats)])
        return np.einsum("nij,nj,nkj->nik", rotations, np.exp(2 * model.scales), rotations)

    directions = np.random.default_rng(0).normal(size=(20, 3))
    # Unspecified; the default; right, down, front; left, up, front.
    for axes, signs in {0: (1, 1, 1), 4: (1, 1, 1), 6: (1, -1, -1), 7: (-1, 1, -1)}.items():
        model = read_as(axes)
        assert np.array_equal(model.means, upright.means * np.float32(signs))
        flipped = covariances(upright) * np.outer(signs, signs)
        np.testing.assert_allclose(covariances(model), flipped, rtol=1e-3, atol=1e-6)
        bases = [sh_basis(each, 16)[:, 1:] for each in (directions, directions * signs)]
        colors = [
            np.einsum("dk,nkc->ndc", basis, each.shN)
            for basis, each in zip(bases, (model, upright), strict=True)
        ]
        np.testing.assert_allclose(*colors, atol=1e-4)
    with pytest.raises(SceneFormatError, match="SPZ_ADOBE_coordinate_system"):
        read_as(12)


# The formats' own tool ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def converter():
    """PlayCanvas's splat-transform: npm install -g @playcanvas/splat-transform."""
    command = os.environ.get("SPLAT_TRANSFORM") or shutil.which("splat-transform")
    if command is None:
        pytest.skip("splat-transform is not installed (npm install -g @playcanvas/splat-transform)")

    def convert(*words):
        words = [str(word) for word in (command, "-w", "-q", *words)]
        run = subprocess.run(words, capture_output=True, text=True, check=False, timeout=120)
        assert run.returncode == 0, run.stdout + run.stderr

    return convert


def _upright(model, suffix, truth):
    """The model as the truth is turned: newer versions do not convert the axes of an .spz."""
    low, high = truth.means.min(axis=0), model.means.min(axis=0)
    if suffix != ".spz" or np.abs(low - high).max() < 0.1:
        return model
    signs = axis_signs(4)  # right, up, back
    return replace(
        model,
        means=model.means * signs.position,
        quats=model.quats * signs.quat,
        shN=model.shN * signs.sh[: model.shN.shape[1], None],
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_splat_transform_reads_our_files(suffix, converter, tmp_path):
    truth = _gaussians()
    write_any(tmp_path / f"ours{suffix}", truth)
    converter(tmp_path / f"ours{suffix}", tmp_path / "theirs.ply")
    limits = [None if limit is None else limit + 1e-6 for limit in LIMITS[suffix]]
    limits[2] = 2 * limits[2] + 0.01  # it takes 127.5 for the middle of a byte, not 128
    theirs = _upright(read_gaussians(tmp_path / "theirs.ply"), suffix, truth)
    _assert_close(theirs, truth, limits)


@pytest.mark.parametrize("suffix", [".compressed.ply", ".spz", ".sog"])
def test_we_read_files_of_splat_transform(suffix, converter, tmp_path):
    truth = _gaussians()
    write_gaussians(tmp_path / "ours.ply", truth)
    converter("-g", "cpu", tmp_path / "ours.ply", tmp_path / f"theirs{suffix}")
    if suffix == ".spz":
        pytest.importorskip("zstandard", reason="version 4 needs zstandard")
    converter(tmp_path / f"theirs{suffix}", tmp_path / "as_they_read_it.ply")
    same = (1e-5, 1e-5, 0.1, 0.002, 1e-5, 1e-5)
    theirs = _upright(read_gaussians(tmp_path / f"theirs{suffix}"), suffix, truth)
    _assert_close(theirs, read_gaussians(tmp_path / "as_they_read_it.ply"), same)
    assert np.abs(np.sort(theirs.means, axis=0) - np.sort(truth.means, axis=0)).max() < 0.02


def test_we_read_gltf_of_splat_transform(converter, tmp_path):
    truth = _gaussians()
    write_gaussians(tmp_path / "ours.ply", truth)
    converter(tmp_path / "ours.ply", tmp_path / "theirs.glb")
    _assert_close(
        read_gaussians(tmp_path / "theirs.glb"), truth, (1e-5, 1e-5, 0.1, 1e-5, 1e-5, 1e-5)
    )
