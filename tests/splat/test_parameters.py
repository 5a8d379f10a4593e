"""Models in other units are converted or refused, and no parameter is dropped silently."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import SceneFormatError
from splatseed.splat.formats import holds_gaussians, read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians

from .test_model_ply import _write


@pytest.fixture(scope="module")
def model():
    """Gaussians on a plane, about as large as their spacing, of opacities as after training."""
    rng = np.random.default_rng(3)
    arrays = {
        "means": np.column_stack([rng.uniform(-2, 2, (400, 2)), np.full(400, 3)]),
        "scales": rng.normal(np.log(0.1), 0.7, (400, 3)),
        "quats": rng.normal(size=(400, 4)),
        "opacities": rng.normal(0, 2, 400),
        "sh0": rng.normal(size=(400, 1, 3)),
        "shN": rng.normal(0, 0.1, (400, 3, 3)),
    }
    return Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})


def _columns(model):
    """The columns of a .ply, by name."""
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rest = model.shN.transpose(0, 2, 1).reshape(len(model), 9)
    parts = [
        model.means,
        model.sh0[:, 0],
        rest,
        model.opacities[:, None],
        model.scales,
        model.quats,
    ]
    return dict(zip(names, np.concatenate(parts, axis=1).T, strict=True))


def _read(path):
    notes = []
    return read_gaussians(path, notes.append), notes


def _same(found, model, atol=2e-6):
    for name, array in model.arrays().items():
        np.testing.assert_allclose(getattr(found, name), array, atol=atol, rtol=1e-4, err_msg=name)


def test_sizes_as_lengths_and_opacities_after_the_sigmoid_are_converted(model, tmp_path):
    columns = _columns(model)
    lengths = {f"scale_{i}": np.exp(columns[f"scale_{i}"]) for i in range(3)}
    activated = {"opacity": 1 / (1 + np.exp(-columns["opacity"]))}
    for change, words in (
        (lengths, ["sizes as lengths"]),
        (activated, ["opacities from 0 to 1"]),
        (lengths | activated, ["sizes as lengths", "opacities from 0 to 1"]),
        ({}, []),
    ):
        found, notes = _read(_write(tmp_path / "m.ply", columns | change))
        _same(found, model, atol=1e-4)
        assert [each.kind for each in notes] == ["converted-values"] * bool(words)
        assert all(word in notes[0].text for word in words)
    # Sizes of 0 as lengths are the thinnest that can be drawn.
    thin = lengths | {"scale_1": np.zeros(400, "<f4")}
    found, _ = _read(_write(tmp_path / "m.ply", columns | thin))
    assert (found.scales[:, 1] < -80).all()
    np.testing.assert_allclose(found.scales[:, 0], model.scales[:, 0], atol=1e-5)


def test_what_may_be_in_either_unit_is_refused(model, tmp_path):
    columns = _columns(model)
    rng = np.random.default_rng(0)
    for name, values in (
        ("opacity", rng.uniform(0.2, 0.7, 400)),  # after a reset, or after the sigmoid
        ("opacity", np.clip(columns["opacity"], 0, 1)),  # exact zeros: no sigmoid
        ("opacity", np.full(400, 0.98)),
        ("opacity", rng.uniform(0, 255, 400)),
    ):
        path = _write(tmp_path / "m.ply", columns | {name: values.astype("<f4")})
        with pytest.raises(SceneFormatError, match="opacities from"):
            read_gaussians(path)
    wide = {f"scale_{i}": rng.uniform(0.5, 2.5, 400).astype("<f4") for i in range(3)}
    spread = {name: 15 * columns[name] for name in "xyz"}
    with pytest.raises(SceneFormatError, match="logarithms or lengths"):
        read_gaussians(_write(tmp_path / "m.ply", columns | spread | wide))


def test_unusual_models_in_3dgs_units_are_read_as_they_are(model, tmp_path):
    """All of size 1 or more, as in millimetres; without faint Gaussians; all at opacity 1/2."""
    columns = _columns(model)
    millimetres = {name: 1000 * columns[name] for name in "xyz"}
    millimetres |= {f"scale_{i}": np.maximum(columns[f"scale_{i}"] + 6.9, 0) for i in range(3)}
    for change in (
        {name: array.astype("<f4") for name, array in millimetres.items()},
        {"opacity": np.abs(columns["opacity"])},
        {"opacity": np.zeros(400, "<f4")},
        {"opacity": np.full(400, np.inf, "<f4")},
    ):
        found, notes = _read(_write(tmp_path / "m.ply", columns | change))
        assert notes == []
        np.testing.assert_array_equal(found.opacities, (columns | change)["opacity"])
        np.testing.assert_array_equal(found.scales[:, 0], (columns | change)["scale_0"])


def test_names_of_cloudcompare_are_read(model, tmp_path):
    columns = _columns(model)
    for prefix in ("scalar_", "scalar_scalar_"):
        named = {name if name in "xyz" else prefix + name: a for name, a in columns.items()}
        path = _write(tmp_path / "m.ply", named)
        found, notes = _read(path)
        _same(found, model, atol=0)
        assert (notes, holds_gaussians(path)) == ([], True)


def test_further_columns_are_named_or_refused(model, tmp_path):
    columns = _columns(model) | {name: np.zeros(400, "<f4") for name in ("nx", "ny", "nz")}
    colors = {name: np.zeros(400, "u1") for name in ("red", "green", "blue")}
    assert _read(_write(tmp_path / "m.ply", columns | colors))[1] == []
    extra = {f"semantic_{i}": columns["x"] for i in range(16)} | {"confidence": columns["x"]}
    found, (finding,) = _read(_write(tmp_path / "m.ply", columns | extra))
    _same(found, model, atol=0)
    assert finding.kind == "unread-parameters"
    assert "confidence, semantic (16)" in finding.text
    assert len(finding.subjects) == 17
    for name in ("sg_dir_0_1", "sg_sharp_0", "beta", "sb_params_3", "features_2", "f_asg_0"):
        path = _write(tmp_path / "m.ply", columns | {name: columns["x"]})
        with pytest.raises(SceneFormatError, match=name):
            read_gaussians(path)


def test_values_beyond_a_format_are_counted(model, tmp_path):
    """The ranges of Niantic's packGaussians: bytes of 255 (0.15 c + 0.5), and 128 c + 128."""
    sh0, shN = np.clip(model.sh0, -3.3, 3.3), np.clip(model.shN, -1, 0.99)
    inside = Gaussians(**(model.arrays() | {"sh0": sh0, "shN": shN}))
    sh0, shN = sh0.copy(), shN.copy()
    sh0[:7, 0, 1], shN[:3, 2, 0], shN[3:9, 0, 2] = 3.6, 1.5, -1.2
    beyond = Gaussians(**(model.arrays() | {"sh0": sh0, "shN": shN}))

    def written(gaussians, suffix):
        notes = []
        write_gaussians(tmp_path / f"m{suffix}", gaussians, note=notes.append)
        return [(each.kind, each.text) for each in notes]

    assert written(inside, ".spz") == []
    (first, text), (_, other) = written(beyond, ".spz")
    assert first == "clipped-colors"
    assert "those of 7 Gaussians of 400" in text
    assert "those of 9 Gaussians of 400" in other
    assert "by up to 0.51" in other  # 1.5 - 127 / 128
    assert written(beyond, ".sog") == written(beyond, ".ply") == []
    # A .splat has colours from 0 to 1: c within 0.5 / 0.2821.
    outside = int((np.abs(sh0) > 0.5 / 0.28209479 + 1 / 64).any(axis=(1, 2)).sum())
    (harmonics, _), (kind, text) = written(beyond, ".splat")
    assert (harmonics, kind) == ("unused-harmonics", "clipped-colors")
    assert f"those of {outside} Gaussians of 400" in text
