"""Models of other trainers and tools: read as their authors define them, or refused by name."""

from __future__ import annotations

import dataclasses
import gzip
import json
import math
import zipfile

import numpy as np
import pytest

from splatseed.camera import Camera
from splatseed.errors import SceneFormatError
from splatseed.photos.view import view_of
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.training_frame import TrainingFrame

from .compressed import write_any

C0 = 0.28209479177387814  # 3DGS, utils/sh_utils.py
KINDS = {"<f4": "float", "<f8": "double", "u1": "uchar", "<u2": "ushort", "<i4": "int"}


def _columns(count=6, rest=9, seed=0):
    rng = np.random.default_rng(seed)
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(rest))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return {name: rng.normal(size=count).astype("<f4") for name in names}


def _write(path, columns, form="binary_little_endian", before="", head=b"", after=""):
    """A .ply with these columns, each of its array's type."""
    count = len(next(iter(columns.values())))
    lines = [f"ply\nformat {form} 1.0\n{before}element vertex {count}"]
    lines += [f"property {KINDS[a.dtype.str.lstrip('|')]} {n}" for n, a in columns.items()]
    header = "\n".join(lines) + f"\n{after}end_header\n"
    if form == "ascii":
        rows = zip(*(array.tolist() for array in columns.values()), strict=True)
        body = "".join(" ".join(map(repr, row)) + "\n" for row in rows).encode()
    else:
        table = np.rec.fromarrays(list(columns.values()), names=list(columns))
        big = table.dtype.newbyteorder(">") if "big" in form else table.dtype
        body = table.astype(big).tobytes()
    path.write_bytes(header.encode() + head + body)
    return path


def _read(path):
    notes = []
    return read_gaussians(path, lambda finding: notes.append(str(finding))), notes


def _same(model, other):
    for name, array in other.arrays().items():
        np.testing.assert_array_equal(getattr(model, name), array, err_msg=name)


# Layouts -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The columns of a model, and how they are read in 3DGS's layout."""
    columns = _columns()
    return columns, read_gaussians(_write(tmp_path_factory.mktemp("plain") / "m.ply", columns))


def test_order_types_and_further_columns_do_not_matter(plain, tmp_path):
    columns, model = plain
    names = list(columns)
    turned = {name: columns[name] for name in names[::-1]}
    turned |= {"nxx": columns["x"], "id": np.arange(6, dtype="<i4")}
    _same(_read(_write(tmp_path / "a.ply", turned))[0], model)
    double = {name: array.astype("<f8") for name, array in columns.items()}
    _same(_read(_write(tmp_path / "b.ply", double))[0], model)
    for form in ("ascii", "binary_big_endian"):
        found, notes = _read(_write(tmp_path / "c.ply", double, form))
        _same(found, model)
        assert notes == []
    camera = "element camera 2\nproperty float focal\n"
    found, _ = _read(_write(tmp_path / "d.ply", columns, before=camera, head=bytes(8)))
    _same(found, model)
    _same(
        _read(_write(tmp_path / "e.ply", double, "ascii", before=camera, head=b"1\n2\n"))[0], model
    )


def test_gaussians_with_nan_or_numbers_beyond_float32_are_dropped(plain, tmp_path):
    columns, _ = plain
    double = {name: array.astype("<f8") for name, array in columns.items()}
    double["scale_1"][2], double["x"][4] = 1e300, -1e300
    for form in ("binary_little_endian", "ascii"):
        model, (note,) = _read(_write(tmp_path / "m.ply", double, form))
        assert len(model) == 4
        assert "position (1), size (1)" in note
    double["x"][4] = np.nan
    assert len(_read(_write(tmp_path / "m.ply", double, "ascii"))[0]) == 4
    short = (tmp_path / "m.ply").read_bytes().rsplit(b"\n", 2)[0]
    (tmp_path / "m.ply").write_bytes(short)
    with pytest.raises(SceneFormatError, match="5 rows"):
        read_gaussians(tmp_path / "m.ply")


@pytest.mark.parametrize(("rest", "degree"), [(0, 0), (9, 1), (24, 2), (45, 3), (72, 3)])
def test_harmonics_of_every_degree_are_read_by_colour(rest, degree, tmp_path):
    columns = _columns(rest=rest)
    model, notes = _read(_write(tmp_path / "m.ply", columns))
    assert model.shN.shape == (6, (degree + 1) ** 2 - 1, 3)
    for color in range(3):
        for k in range(model.shN.shape[1]):
            expected = columns[f"f_rest_{color * (rest // 3) + k}"]
            np.testing.assert_array_equal(model.shN[:, k, color], expected)
    assert len(notes) == (rest == 72)


@pytest.mark.parametrize(
    ("kind", "top"), [("u1", 255), ("<u2", 65535), ("<f4", 1), ("<f4", 255), ("<f8", 255)]
)
def test_rgb_replaces_the_first_coefficient(plain, kind, top, tmp_path):
    columns = {name: array for name, array in plain[0].items() if "f_dc" not in name}
    levels = np.array([0, 0.2, 0.4, 0.6, 0.8, 1])
    columns |= {name: (levels * top).astype(kind) for name in ("red", "green", "blue")}
    model, _ = _read(_write(tmp_path / "m.ply", columns))
    # 3DGS, RGB2SH: (rgb - 0.5) / C0
    expected = np.repeat((levels[:, None] - 0.5) / C0, 3, axis=1)
    np.testing.assert_allclose(model.sh0[:, 0], expected, atol=1e-5)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"opacity": None}, "no opacity"),
        ({"scale_0": None}, "no scale_0"),
        ({"rot_3": None}, "no rot_3"),
        ({"f_dc_1": None}, "no f_dc_1"),
        ({"f_rest_4": None}, "no f_rest_4"),
        ({"f_rest_8": None}, "8 f_rest"),
        ({"f_anchor_feat_0": "x", "f_offset_0": "x"}, "anchors .*f_anchor_feat_0"),
        ({"f_dc_0": None, "f_offset_3": "x"}, "anchors .*f_offset_3"),
        ({"trbf_center": "x"}, "Gaussians that move.*trbf_center"),
        ({"sb_params_0": "x"}, "Beta kernels.*sb_params_0"),
    ],
)
def test_unsupported_models_are_refused_by_name(plain, change, word, tmp_path):
    columns = dict(plain[0])
    for name, source in change.items():
        if source is None:
            del columns[name]
        else:
            columns[name] = columns[source]
    with pytest.raises(SceneFormatError, match=word):
        read_gaussians(_write(tmp_path / "m.ply", columns))


def test_a_list_is_refused_by_name(plain, tmp_path):
    listed = "property list uchar int views\n"
    with pytest.raises(SceneFormatError, match="the list property views"):
        read_gaussians(_write(tmp_path / "m.ply", plain[0], after=listed))


# Other kinds of Gaussians ------------------------------------------------------------------------


def test_mip_splattings_filter_is_applied(plain, tmp_path):
    """Its scene/gaussian_model.py: scales sqrt(s^2 + f^2), opacity times sqrt(det1 / det2)."""
    columns = plain[0] | {"filter_3D": np.array([0.5, 0.02, 3, 0, 1e-12, 1], "<f4")}
    columns["opacity"] = np.array([-3, 0, 2, 5, np.inf, -np.inf], "<f4")
    model, (note,) = _read(_write(tmp_path / "m.ply", columns))
    assert "filter_3D" in note
    for i in range(6):
        sizes = [math.exp(columns[f"scale_{k}"][i]) for k in range(3)]
        f = float(columns["filter_3D"][i])
        wide = [math.sqrt(s * s + f * f) for s in sizes]
        alpha = 1 / (1 + math.exp(-float(columns["opacity"][i])))
        alpha *= math.sqrt(math.prod(s * s for s in sizes) / math.prod(s * s for s in wide))
        np.testing.assert_allclose(np.exp(model.scales[i]), wide, rtol=1e-6)
        assert 1 / (1 + math.exp(-model.opacities[i])) == pytest.approx(alpha, rel=1e-5)
    assert model.opacities[3] == 5  # f = 0 changes no bit
    assert model.scales[3].tolist() == [columns[f"scale_{k}"][3] for k in range(3)]
    write_gaussians(tmp_path / "out.ply", model)  # applied once
    _same(_read(tmp_path / "out.ply")[0], model)
    columns["filter_3D"][2] = np.nan
    assert len(_read(_write(tmp_path / "m.ply", columns))[0]) == 5


def test_two_sizes_give_a_disc_and_one_a_sphere(plain, tmp_path):
    columns = {name: array for name, array in plain[0].items() if name != "scale_2"}
    model, (note,) = _read(_write(tmp_path / "m.ply", columns))
    assert "2D Gaussian Splatting" in note
    np.testing.assert_array_equal(model.scales[:, 0], columns["scale_0"])
    np.testing.assert_array_equal(model.scales[:, 1], columns["scale_1"])
    assert (model.scales[:, 2] < model.scales[:, :2].min(axis=1) - 4).all()
    assert np.isfinite(model.scales).all()
    ball = {name: a for name, a in columns.items() if name != "scale_1" and "rot" not in name}
    model, (note,) = _read(_write(tmp_path / "m.ply", ball))
    assert "scale_0" in note
    np.testing.assert_array_equal(model.scales, np.stack([columns["scale_0"]] * 3, axis=1))
    assert (model.quats == [1, 0, 0, 0]).all()


def _seen(gaussians, width=48):
    """The render from the origin along z, focal length as large as the picture."""
    rendering = pytest.importorskip("splatseed.splat.rendering", reason="needs PyTorch")
    K = np.array([[width, 0, width / 2], [0, width, width / 2], [0, 0, 1.0]])
    view = view_of(Camera(K, width, width, np.eye(4)))
    frame = TrainingFrame(np.zeros(3), 1.0)
    return rendering.ModelRenderer(gaussians, frame).image(view).numpy()[..., 0]


def _white(scales, opacity, quat=(1, 0, 0, 0), depth=4.0):
    arrays = {
        "means": [[0, 0, depth]],
        "scales": [np.log(scales)],
        "quats": [quat],
        "opacities": [np.log(opacity / (1 - opacity))],
        "sh0": np.full((1, 1, 3), 0.5 / C0),
        "shN": np.zeros((1, 0, 3)),
    }
    return Gaussians(**{name: np.array(array, np.float32) for name, array in arrays.items()})


def test_a_disc_renders_as_in_2dgs(tmp_path):
    """Huang et al., 2024: a ray meets the disc's plane at (u, v), in sizes; alpha o exp(-r^2/2)."""
    turn = np.deg2rad(55) / 2  # about y
    disc = _white([0.5, 0.25, 1], 0.8, (np.cos(turn), 0, np.sin(turn), 0))
    write_gaussians(tmp_path / "m.ply", disc)
    content = (tmp_path / "m.ply").read_bytes().replace(b"scale_2", b"unknown")
    (tmp_path / "m.ply").write_bytes(content)
    image = _seen(_read(tmp_path / "m.ply")[0])
    at = (np.arange(48) + 0.5 - 24) / 48
    x, y = np.meshgrid(at, at)
    first = np.array([np.cos(2 * turn), 0, -np.sin(2 * turn)])
    normal = np.array([np.sin(2 * turn), 0, np.cos(2 * turn)])
    depth = 4 * normal[2] / (x * normal[0] + normal[2])
    u = (x * depth * first[0] + (depth - 4) * first[2]) / 0.5
    v = y * depth / 0.25
    expected = 0.8 * np.exp(-(u**2 + v**2) / 2)
    assert np.abs(image - expected).mean() < 0.01
    assert image.max() == pytest.approx(0.8, abs=0.02)


# Antialiasing ------------------------------------------------------------------------------------


def test_antialiasing_round_trips_and_affects_the_render(tmp_path):
    """A Gaussian of 0.1 px in a blur of 0.3 px^2 keeps its integral instead of its opacity."""
    model = dataclasses.replace(_white([0.1 / 12] * 3, 0.9), antialiased=True)
    for suffix in (".ply", ".compressed.ply", ".spz", ".sog"):
        write_any(tmp_path / f"m{suffix}", model)
        assert read_gaussians(tmp_path / f"m{suffix}").antialiased, suffix
        write_any(tmp_path / f"m{suffix}", dataclasses.replace(model, antialiased=False))
        assert not read_gaussians(tmp_path / f"m{suffix}").antialiased, suffix
    plain, faint = (_seen(dataclasses.replace(model, antialiased=each)) for each in (False, True))
    np.testing.assert_allclose(faint.max() / plain.max(), 0.01 / 0.31, rtol=0.02)
    notes = []
    write_gaussians(tmp_path / "m.splat", model, note=notes.append)
    assert [each.kind for each in notes] == ["antialiasing-lost"]


def test_antialiasing_flags_of_other_programs_are_read(plain, tmp_path):
    columns, _ = plain
    for comments, said in (
        ("comment SplatRenderMode: mip", True),  # Brush
        ("comment antialiased 1", True),  # Postshot
        ("comment SplatRenderMode: mip\ncomment SplatRenderMode: default", False),
        ("comment antialiased 0", False),
        ("comment is not antialiased 1", False),
    ):
        path = _write(tmp_path / "m.ply", columns, before=f"{comments}\n")
        assert read_gaussians(path).antialiased is said, comments
    model = _white([0.1] * 3, 0.9)
    write_gaussians(tmp_path / "m.spz", model)
    raw = bytearray(gzip.decompress((tmp_path / "m.spz").read_bytes()))
    raw[14] |= 1  # flags: magic, version, count, degree, fractional bits before them
    (tmp_path / "m.spz").write_bytes(gzip.compress(bytes(raw)))
    assert read_gaussians(tmp_path / "m.spz").antialiased
    write_gaussians(tmp_path / "m.sog", dataclasses.replace(model, antialiased=True))
    with zipfile.ZipFile(tmp_path / "m.sog") as archive:
        assert json.loads(archive.read("meta.json"))["model"] == "antialiased"
    with (tmp_path / "m.sog").open("rb") as file:
        assert file.read(2) == b"PK"


def test_spz_harmonics_of_degree_4_are_truncated_to_degree_3(tmp_path):
    body = bytes(9) + bytes([200]) + bytes([128] * 3) + bytes([100] * 3)
    body += np.array([3 << 30], "<u4").tobytes() + bytes(range(100, 172))
    header = b"NGSP" + np.array([3, 1], "<u4").tobytes() + bytes([4, 12, 0, 0])
    (tmp_path / "m.spz").write_bytes(gzip.compress(header + body))
    model, (note,) = _read(tmp_path / "m.spz")
    assert model.shN.shape == (1, 15, 3)
    assert abs(model.shN[0, 2, 1]) == pytest.approx((107 - 128) / -128)  # coefficient 2, green
    assert "Of 24 coefficients" in note
