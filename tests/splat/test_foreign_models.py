"""Checkpoints, gsplat's PNG folders and glTF: written here by their programs' formulas."""

from __future__ import annotations

import base64
import io
import json
import struct
import zipfile

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import rotation_from_quat
from splatseed.errors import ParameterError, SceneFormatError
from splatseed.splat.formats import (
    detect_format,
    format_of_name,
    holds_gaussians,
    read_gaussians,
    round_trip,
    write_gaussians,
)
from splatseed.splat.gaussians import Gaussians

from .test_formats import _gaussians

COUNT = 64


@pytest.fixture(scope="module")
def model():
    return _gaussians(COUNT)


def _read(path):
    notes = []
    return read_gaussians(path, notes.append), [each.kind for each in notes]


def _same(found, model):
    for name, array in model.arrays().items():
        np.testing.assert_array_equal(getattr(found, name), array, err_msg=name)


# Checkpoints -------------------------------------------------------------------------------------


@pytest.fixture
def tensors(model):
    torch = pytest.importorskip("torch", reason="checkpoints need PyTorch")
    return {name: torch.tensor(array) for name, array in model.arrays().items()}


def test_a_checkpoint_of_gsplat_is_read_with_those_of_other_gpus(model, tensors, tmp_path):
    import torch

    path = tmp_path / "ckpt_6999_rank0.pt"
    torch.save({"step": 6999, "splats": tensors, "pose_adjust": {"x": torch.zeros(2)}}, path)
    assert detect_format(path, path.read_bytes()) == "checkpoint"
    found, kinds = _read(path)
    _same(found, model)
    assert kinds == []
    torch.save({"step": 7, "splats": tensors}, tmp_path / "ckpt_7_rank0.pt")  # another step
    for rank, part in enumerate((slice(0, 40), slice(40, None))):
        splats = {name: tensor[part] for name, tensor in tensors.items()}
        torch.save({"step": 1, "splats": splats}, tmp_path / f"ckpt_6999_rank{rank}.pt")
    found, kinds = _read(path)
    _same(found, model)
    assert kinds == ["joined-checkpoints"]
    (tmp_path / "cfg.yml").write_text("ant: 1\nantialiased: true\n")
    assert read_gaussians(path).antialiased


def test_a_checkpoint_of_nerfstudio_is_read(model, tensors, tmp_path):
    import torch

    names = {"sh0": "features_dc", "shN": "features_rest"}
    shaped = tensors | {"sh0": tensors["sh0"][:, 0], "opacities": tensors["opacities"][:, None]}
    state = {
        f"_model.gauss_params.{names.get(n, n)}": torch.nn.Parameter(t) for n, t in shaped.items()
    }
    state["_model.camera_optimizer.pose_adjustment"] = torch.zeros(3, 6)
    path = tmp_path / "step-000029999.ckpt"
    torch.save({"step": 29999, "pipeline": state, "optimizers": {}, "scalers": {}}, path)
    found, kinds = _read(path)
    _same(found, model)
    assert kinds == []
    # splatfacto with sh_degree 0: colours are a sigmoid
    state["_model.gauss_params.features_rest"] = torch.zeros(COUNT, 0, 3)
    torch.save({"step": 1, "pipeline": state}, path)
    color = 0.5 + 0.28209479177387814 * read_gaussians(path).sh0
    np.testing.assert_allclose(color, 1 / (1 + np.exp(-model.sh0)), atol=1e-6)
    state["_model.gauss_params.instance_feats"] = torch.zeros(COUNT, 4)
    torch.save({"step": 1, "pipeline": state}, path)
    assert _read(path)[1] == ["unread-parameters"]


def test_a_checkpoint_of_graphdeco_is_read(model, tensors, tmp_path):
    """Its scene/gaussian_model.py, capture: degree, xyz, dc, rest, scaling, rotation, opacity."""
    import torch

    order = ("means", "sh0", "shN", "scales", "quats", "opacities")
    own = [torch.nn.Parameter(tensors[name]) for name in order]
    own[-1] = own[-1][:, None]
    torch.save(
        ((3, *own, torch.zeros(3), torch.zeros(3), torch.zeros(3), {}, 1.0), 7000),
        tmp_path / "c.pth",
    )
    _same(read_gaussians(tmp_path / "c.pth"), model)


def test_other_checkpoints_say_what_they_are(tensors, tmp_path):
    import torch

    for content, word in (
        ({"epoch": 3, "state_dict": {}}, "other content: epoch, state_dict"),
        ({"splats": {"means": tensors["means"]}}, "no scales"),
        (
            {"splats": tensors | {"features": tensors["quats"]}},
            "a network computes colours: features",
        ),
        ({"step": 1, "params": {}, "strategy": {}}, "unfinished run of splatseed"),
        ({"splats": tensors | {"quats": tensors["scales"]}}, "another shape"),
        (SceneFormatError("a", found="b", fix="c"), "objects other than tensors"),
    ):
        torch.save(content, tmp_path / "m.pt")
        with pytest.raises(SceneFormatError, match=word) as caught:
            read_gaussians(tmp_path / "m.pt")
        assert "splat-transform" not in str(caught.value)
    (tmp_path / "m.ckpt").write_bytes(b"\x80\x02 nothing")
    with pytest.raises(SceneFormatError, match="damaged"):
        read_gaussians(tmp_path / "m.ckpt")
    with zipfile.ZipFile(tmp_path / "m.zip", "w") as archive:
        archive.writestr("scene/a.ply", b"ply")
    with pytest.raises(SceneFormatError, match=r"an archive of a\.ply.*Unpack"):
        read_gaussians(tmp_path / "m.zip")
    with pytest.raises(ParameterError, match=r"Write a \.ply"):
        format_of_name(tmp_path / "m.ckpt")


# gsplat's PNGs -----------------------------------------------------------------------------------


def _png_folder(folder, model, *, harmonics=True, quats=True):
    """gsplat 1.5.3, compression/png_compression.py, with as many clusters as Gaussians."""
    side, meta = int(np.sqrt(len(model))), {}

    def bounds(name, values):
        low, high = values.min(axis=0), values.max(axis=0)
        meta[name] = {"shape": list(getattr(model, name).shape), "dtype": "float32"}
        meta[name] |= {"mins": low.tolist(), "maxs": high.tolist()}
        return (values - low) / (high - low)

    means = model.means.astype(float)
    unit = bounds("means", np.sign(means) * np.log1p(np.abs(means)))
    steps = np.rint(unit * 65535).astype(np.uint16).reshape(side, side, 3)
    for name, part in (("means_l", steps & 255), ("means_u", steps >> 8)):
        PilImage.fromarray(part.astype(np.uint8)).save(folder / f"{name}.png")
    for name in ("scales", "opacities", "sh0", *["quats"] * quats):
        values = getattr(model, name).reshape(len(model), -1).astype(float)
        codes = np.rint(bounds(name, values) * 255).astype(np.uint8)
        PilImage.fromarray(codes.reshape(side, side, -1).squeeze()).save(folder / f"{name}.png")
    if harmonics:
        flat = model.shN.reshape(len(model), -1)
        low, high = float(flat.min()), float(flat.max())
        centroids = np.rint((flat - low) / (high - low) * 63).astype(np.uint8)
        labels = np.arange(len(model), dtype=np.uint16)[::-1]
        np.savez(folder / "shN.npz", centroids=centroids[::-1], labels=labels)
        meta["shN"] = {"shape": list(model.shN.shape), "dtype": "float32", "quantization": 6}
        meta["shN"] |= {"mins": low, "maxs": high}
    (folder / "meta.json").write_text(json.dumps(meta))


def test_gsplats_png_compression_is_read(model, tmp_path):
    _png_folder(tmp_path, model)
    assert holds_gaussians(tmp_path / "meta.json")
    for path in (tmp_path, tmp_path / "meta.json"):
        found, kinds = _read(path)
        assert kinds == []
        for name, array in model.arrays().items():
            steps = {"means": 65535, "shN": 63}.get(name, 255)
            limit = (
                0.51
                * float(np.ptp(array, axis=0).max() if name != "shN" else np.ptp(array))
                / steps
            )
            limit *= 30 if name == "means" else 1  # steps of a logarithm
            assert np.abs(getattr(found, name) - array).max() <= limit, name
    _png_folder(tmp_path, model, harmonics=False, quats=False)
    found, kinds = _read(tmp_path)
    assert (kinds, found.sh_degree) == (["missing-rotations"], 0)
    (tmp_path / "sh0.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"sh0\.png"):
        read_gaussians(tmp_path)


def test_gsplats_own_reader_agrees(model, tmp_path):
    pytest.importorskip("imageio", reason="gsplat reads PNGs by imageio")
    compression = pytest.importorskip("gsplat.compression.png_compression", reason="needs gsplat")
    _png_folder(tmp_path, model)
    splats = compression.PngCompression().decompress(str(tmp_path))
    found = read_gaussians(tmp_path)
    for name, array in found.arrays().items():
        np.testing.assert_allclose(array, splats[name].numpy(), atol=1e-5, err_msg=name)


# SOG of version 1 --------------------------------------------------------------------------------


def test_a_sog_of_version_1_is_read(model, tmp_path):
    """splat-transform, readers/read-sog-v1.ts: bytes between bounds, opacities as logits."""
    write_gaussians(tmp_path / "m.sog", model)
    with zipfile.ZipFile(tmp_path / "m.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
        images = {name: archive.read(name) for name in archive.namelist() if "webp" in name}
    rng, labels = np.random.default_rng(0), np.arange(COUNT) % 7
    codes = {
        "scales": rng.integers(0, 256, (COUNT, 3)),
        "sh0": rng.integers(0, 256, (COUNT, 4)),
        "shN_centroids": rng.integers(0, 256, (1, 64 * 3, 3)),
        "shN_labels": np.column_stack([labels, labels * 0, labels * 0]),
    }
    for name, values in codes.items():
        shaped = values if values.ndim == 3 else values.reshape(8, 8, -1)
        file = io.BytesIO()
        PilImage.fromarray(shaped.astype(np.uint8)).save(file, "WEBP", lossless=True, exact=True)
        images[f"{name}.webp"] = file.getvalue()
    first = {
        "means": {**meta["means"], "shape": [COUNT, 3]},
        "quats": meta["quats"],
        "scales": {"mins": [-9, -8, -7], "maxs": [-1, -2, -3], "files": ["scales.webp"]},
        "sh0": {"mins": [-1, -1, -2, -6], "maxs": [1, 2, 2, 9], "files": ["sh0.webp"]},
        "shN": {"mins": -0.5, "maxs": 0.25, "files": ["shN_centroids.webp", "shN_labels.webp"]},
    }
    with zipfile.ZipFile(tmp_path / "m.sog", "w") as archive:
        archive.writestr("inner/meta.json", json.dumps(first))
        for name, content in images.items():
            archive.writestr(f"inner/{name}", content)
    found = read_gaussians(tmp_path / "m.sog")
    expected = np.array([-9, -8, -7]) + codes["scales"] / 255 * np.array([8, 6, 4])
    np.testing.assert_allclose(found.scales, expected, atol=1e-5)
    expected = np.array([-1, -1, -2, -6]) + codes["sh0"] / 255 * np.array([2, 3, 4, 15])
    np.testing.assert_allclose(found.sh0[:, 0], expected[:, :3], atol=1e-5)
    np.testing.assert_allclose(found.opacities, expected[:, 3], atol=1e-5)
    table = codes["shN_centroids"].reshape(64, 3, 3)
    np.testing.assert_allclose(found.shN, -0.5 + table[labels] / 255 * 0.75, atol=1e-5)
    first["version"] = 3
    with zipfile.ZipFile(tmp_path / "m.sog", "w") as archive:
        archive.writestr("meta.json", json.dumps(first))
    with pytest.raises(SceneFormatError, match="version 3"):
        read_gaussians(tmp_path / "m.sog")


# glTF --------------------------------------------------------------------------------------------

PREFIX = "KHR_gaussian_splatting:"


def _gltf(attributes, node=None, extension=None, stored=None):
    """The JSON and the buffer of one primitive; ``stored`` has integers of some attributes."""
    accessors, views, names, body = [], [], {}, b""
    for name, values in attributes.items():
        kept, component = (stored or {}).get(name, (values.astype("<f4"), 5126))
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[kept.shape[1]]
        data = kept.tobytes()
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": len(data)})
        names[name] = len(accessors)
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": component,
                "count": len(kept),
                "type": kind,
            }
            | {"normalized": component != 5126}
        )
        body += data + bytes(-len(data) % 4)
    found = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", **(extension or {})}
    primitive = {"mode": 0, "attributes": names, "extensions": {PREFIX[:-1]: found}}
    content = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "scene": 0}
    content |= {"nodes": [{"mesh": 0, **(node or {})}], "meshes": [{"primitives": [primitive]}]}
    content |= {
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    return content, body


def _covariances(model):
    axes = [
        rotation_from_quat(quat) * np.exp(s)
        for quat, s in zip(model.quats, model.scales, strict=True)
    ]
    return np.array([each @ each.T for each in axes])


def _write_glb(path, *args, **options):
    content, body = _gltf(*args, **options)
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(body), 0x004E4942) + body
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    return path


def _attributes(model, degree=1):
    """By the extension's table: lengths, opacities from 0 to 1, xyzw, a coefficient each."""
    unit = model.quats / np.linalg.norm(model.quats, axis=1, keepdims=True)
    found = {
        "POSITION": model.means,
        f"{PREFIX}ROTATION": unit[:, [1, 2, 3, 0]],
        f"{PREFIX}SCALE": np.exp(model.scales),
        f"{PREFIX}OPACITY": 1 / (1 + np.exp(-model.opacities[:, None])),
        f"{PREFIX}SH_DEGREE_0_COEF_0": model.sh0[:, 0],
    }
    order = [(d, n) for d in range(1, degree + 1) for n in range(2 * d + 1)]
    return found | {
        f"{PREFIX}SH_DEGREE_{d}_COEF_{n}": model.shN[:, i] for i, (d, n) in enumerate(order)
    }


def test_gaussians_of_gltf_are_read_in_our_axes(model, tmp_path):
    """glTF's y is up and its x is left, so ours are minus both; as colours seen along them."""
    found, kinds = _read(_write_glb(tmp_path / "m.glb", _attributes(model, 3)))
    assert kinds == ["gltf-axes"]
    np.testing.assert_array_equal(found.means, model.means * np.float32([-1, -1, 1]))
    np.testing.assert_allclose(found.scales, model.scales, atol=1e-5)
    np.testing.assert_allclose(found.opacities, model.opacities, atol=1e-4)
    assert detect_format(tmp_path / "m.glb", (tmp_path / "m.glb").read_bytes()) == "glb"
    assert holds_gaussians(tmp_path / "m.glb")
    pytest.importorskip("torch", reason="turning harmonics needs PyTorch")
    from splatseed.similarity import Similarity
    from splatseed.splat.model_frame import transform_gaussians

    turned = transform_gaussians(model, Similarity(1.0, np.diag([-1.0, -1.0, 1.0]), np.zeros(3)))
    np.testing.assert_allclose(found.shN, turned.shN, atol=1e-5)
    np.testing.assert_allclose(_covariances(found), _covariances(turned), rtol=1e-3, atol=1e-7)


def test_nodes_quantised_attributes_and_gltf_with_buffers_are_read(model, tmp_path):
    unit = model.quats / np.linalg.norm(model.quats, axis=1, keepdims=True)
    opacity = 1 / (1 + np.exp(-model.opacities[:, None]))
    stored = {
        f"{PREFIX}ROTATION": (np.rint(unit[:, [1, 2, 3, 0]] * 32767).astype("<i2"), 5122),
        f"{PREFIX}OPACITY": (np.rint(opacity * 65535).astype("<u2"), 5123),
    }
    node = {"translation": [1, 2, 3], "scale": [2, 2, 2]}
    content, body = _gltf(_attributes(model), node, stored=stored)
    content["buffers"][0]["uri"] = f"data:;base64,{base64.b64encode(body).decode()}"
    (tmp_path / "m.gltf").write_text(json.dumps(content))
    found = read_gaussians(tmp_path / "m.gltf")
    expected = (2 * model.means + [1, 2, 3]) * [-1, -1, 1]
    np.testing.assert_allclose(found.means, expected, atol=1e-5)
    np.testing.assert_allclose(found.scales, model.scales + np.log(2), atol=1e-5)
    np.testing.assert_allclose(1 / (1 + np.exp(-found.opacities)), opacity[:, 0], atol=1e-5)
    content["buffers"][0]["uri"] = "some%20data.bin"
    (tmp_path / "some data.bin").write_bytes(body)
    (tmp_path / "m.gltf").write_text(json.dumps(content))
    np.testing.assert_array_equal(read_gaussians(tmp_path / "m.gltf").means, found.means)
    (first,) = content["meshes"][0]["primitives"]
    plain = {name: index for name, index in first["attributes"].items() if "DEGREE_1" not in name}
    content["meshes"][0]["primitives"] = [first, {**first, "attributes": plain}]
    (tmp_path / "m.gltf").write_text(json.dumps(content))
    both = read_gaussians(tmp_path / "m.gltf")
    assert both.shN.shape == (2 * COUNT, 3, 3)
    assert not both.shN[COUNT:].any()
    np.testing.assert_array_equal(both.shN[:COUNT], found.shN)
    pytest.importorskip("torch", reason="turning harmonics needs PyTorch")
    half = np.sqrt(0.5)  # 90 degrees about z: x to y
    path = _write_glb(tmp_path / "m.glb", _attributes(model), {"rotation": [0, 0, half, half]})
    turned = np.column_stack([-model.means[:, 1], model.means[:, 0], model.means[:, 2]])
    np.testing.assert_allclose(read_gaussians(path).means, turned * [-1, -1, 1], atol=1e-5)


def test_other_gltf_says_what_it_is(model, tmp_path):
    attributes = _attributes(model)
    less = {name: a for name, a in attributes.items() if not name.endswith("1_COEF_2")}
    for given, options, word in (
        (attributes, {"extension": {"colorSpace": "lin_rec709_display"}}, "lin_rec709_display"),
        (attributes, {"extension": {"kernel": "sphere"}}, "kernel 'sphere'"),
        (attributes, {"extension": {"extensions": {"KHR_x_spz_2": {}}}}, "KHR_x_spz_2"),
        (attributes, {"node": {"scale": [1, 1, 2]}}, "stretches"),
        (less, {}, "SH_DEGREE_1_COEF_2"),
    ):
        with pytest.raises(SceneFormatError, match=word) as caught:
            read_gaussians(_write_glb(tmp_path / "m.glb", given, **options))
        assert "splat-transform" not in str(caught.value)
    content = _write_glb(tmp_path / "m.glb", attributes).read_bytes()
    (tmp_path / "m.glb").write_bytes(
        content.replace(b'"KHR_gaussian_splatting"', b'"KHR_gaussian_splattinX"')
    )
    with pytest.raises(SceneFormatError, match="points or meshes without"):
        read_gaussians(tmp_path / "m.glb")
    (tmp_path / "m.glb").write_bytes(content[:-100])
    with pytest.raises(SceneFormatError, match="complete glTF"):
        read_gaussians(tmp_path / "m.glb")
    _, kinds = _read(
        _write_glb(tmp_path / "m.glb", attributes | {"_LABEL": attributes[f"{PREFIX}OPACITY"]})
    )
    assert "unread-parameters" in kinds


def test_a_round_trip_is_what_is_read_from_the_file(model, tmp_path):
    write_gaussians(tmp_path / "m.spz", model)
    _same(round_trip(model, ".spz"), read_gaussians(tmp_path / "m.spz"))
    _same(round_trip(model, ".ply"), model)
    assert isinstance(round_trip(model, ".sog"), Gaussians)
