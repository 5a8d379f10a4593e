"""Networks in transformers' format: what they predict, where; what is written, and refused."""

from __future__ import annotations

import importlib.util
import json
import shutil
import socket
from dataclasses import replace
from functools import partial
from importlib import import_module

import numpy as np
import pytest
from PIL import Image as PilImage

pytest.importorskip("torch", reason="networks of transformers need PyTorch")
if importlib.util.find_spec("transformers") is None:
    pytest.skip("needs splatseed[depth]", allow_module_level=True)

import torch
from safetensors.torch import load_file, save_file

from splatseed.errors import (
    MissingDependencyError,
    OutputError,
    ParameterError,
    SceneFormatError,
    SceneNotFoundError,
)
from splatseed.io import find_depths, load_scene

IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
HEADS = {"num_hidden_layers": 4, "num_attention_heads": 2, "hidden_size": 16}
NECK = {"neck_hidden_sizes": [8, 8, 8, 8]}
DINOV2 = {
    **HEADS, "mlp_ratio": 2, "image_size": 28, "patch_size": 14, "out_indices": [1, 2, 3, 4],
    "reshape_hidden_states": False,
}  # fmt: skip
BEIT = {
    **HEADS, "image_size": 32, "patch_size": 16, "intermediate_size": 32,
    "reshape_hidden_states": False, "use_relative_position_bias": True,
    "out_features": ["stage1", "stage2", "stage3", "stage4"],
}  # fmt: skip
ANYTHING = {**NECK, "reassemble_hidden_size": 16, "fusion_hidden_size": 8, "head_hidden_size": 4}
BY_14 = {
    "size": {"height": 56, "width": 56}, "keep_aspect_ratio": True, "ensure_multiple_of": 14,
    "resample": 3, **IMAGENET,
}  # fmt: skip
SAVED = {
    "depth_anything": ("DepthAnything", ANYTHING, BY_14),
    "dpt": (
        "DPT",
        {
            **HEADS, **NECK, "intermediate_size": 32, "image_size": 32, "patch_size": 16,
            "fusion_hidden_size": 16, "backbone_out_indices": [0, 1, 2, 3],
        },
        {"size": {"height": 32, "width": 32}},
    ),
    # As published for NYU and KITTI: not resized, padded to whole patches.
    "dpt_on_dinov2": (
        "DPT",
        {**NECK, "fusion_hidden_size": 16},
        {"do_resize": False, "do_pad": True, "size_divisor": 14, **IMAGENET},
    ),
    "glpn": (
        "GLPN",
        {
            "num_encoder_blocks": 2, "depths": [1, 1], "sr_ratios": [2, 1], "strides": [4, 2],
            "hidden_sizes": [8, 16], "patch_sizes": [7, 3], "num_attention_heads": [1, 2],
            "mlp_ratios": [2, 2], "decoder_hidden_size": 8,
        },
        {},
    ),
    "zoedepth": (
        "ZoeDepth",
        {
            **NECK, "fusion_hidden_size": 8, "bottleneck_features": 8, "bin_embedding_dim": 8,
            "num_relative_features": 4, "num_attractors": [4, 2, 2, 1],
            "bin_configurations": [
                {"n_bins": 8, "min_depth": 0.001, "max_depth": 10.0, "name": "nyu"}
            ],
        },
        {"size": {"height": 64, "width": 96}, "ensure_multiple_of": 32},
    ),
}  # fmt: skip
"""Networks by name: the kind and configuration of each, and of its image processor."""


@pytest.fixture(scope="module")
def transformers():
    """The package, whose import would take a third of the time to collect all tests."""
    return import_module("transformers")


@pytest.fixture(scope="module")
def monocular():
    """What is tested, which imports the package as well."""
    return import_module("splatseed.depth.monocular")


def save_network(transformers, name, folder):
    """Save a network with random weights, large enough to make a map that is not flat."""
    kind, options, sizes = SAVED[name]
    processor = "DPT" if kind == "DepthAnything" else kind
    if kind == "DepthAnything" or name == "dpt_on_dinov2":
        options = {**options, "backbone_config": transformers.Dinov2Config(**DINOV2)}
    elif kind == "ZoeDepth":
        options = {**options, "backbone_config": transformers.BeitConfig(**BEIT)}
    config = getattr(transformers, f"{kind}Config")(**options)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        network = getattr(transformers, f"{kind}ForDepthEstimation")(config)
        for weight in network.parameters():
            if weight.ndim > 1:
                torch.nn.init.normal_(weight, std=weight[0].numel() ** -0.5)
    network.save_pretrained(folder)
    getattr(transformers, f"{processor}ImageProcessorPil")(**sizes).save_pretrained(folder)
    return folder


KINDS = {"depth_anything": "inverse", "dpt": "inverse"} | dict.fromkeys(
    ("dpt_on_dinov2", "glpn"), "z"
)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def saved(transformers, tmp_path_factory):
    """The folder of a network by its name. Not to be written to."""
    folder = tmp_path_factory.mktemp("networks")
    return {name: save_network(transformers, name, folder / name) for name in SAVED}


@pytest.fixture(scope="module")
def processor_of(transformers):
    """Loads the image processor of a network's folder."""
    return partial(transformers.AutoImageProcessor.from_pretrained, backend="pil")


@pytest.fixture(scope="module")
def identity(transformers, processor_of):
    """A network that predicts the first channel of its input: a map shows where its pixels lie."""

    class Identity(transformers.PreTrainedModel):
        def __init__(self, path):
            super().__init__(transformers.AutoConfig.from_pretrained(path))
            self.weight, processor = torch.nn.Parameter(torch.zeros(1)), processor_of(path)
            normalises = processor.do_normalize
            self.mean = processor.image_mean[0] if normalises else 0.0
            self.std = processor.image_std[0] if normalises else 1.0

        def forward(self, pixel_values):
            depth = (pixel_values[:, 0] * self.std + self.mean) * 255
            return transformers.modeling_outputs.DepthEstimatorOutput(predicted_depth=depth)

    return Identity


@pytest.fixture
def photographs(rng):
    """Three of noise, 90 x 60."""
    return [rng.integers(0, 256, (60, 90, 3), dtype=np.uint8) for _ in range(3)]


@pytest.fixture
def ramp():
    """A photograph, 118 x 77, that is u + v with (u, v) the pixel's centre."""
    v, u = np.mgrid[:77, :118] + 0.5
    return np.repeat((u + v)[..., None], 3, axis=2).astype(np.uint8)


def test_the_kind_of_a_network_comes_from_its_config_or_an_argument(monocular, saved, tmp_path):
    for name in KINDS:
        assert monocular.load_network(str(saved[name]), device="cpu").meaning.kind == KINDS[name]
    assert (
        monocular.load_network(str(saved["dpt"]), depth_kind="ray", device="cpu").meaning.kind
        == "ray"
    )
    folder = shutil.copytree(saved["depth_anything"], tmp_path / "copy")
    config = json.loads((folder / "config.json").read_text())
    metric = {**config, "depth_estimation_type": "metric", "max_depth": 20}
    (folder / "config.json").write_text(json.dumps(metric))
    assert monocular.load_network(str(folder), device="cpu").meaning.kind == "z"
    unknown = {**config, "model_type": "prompt_depth_anything"}
    (folder / "config.json").write_text(json.dumps(unknown))
    with pytest.raises(ParameterError, match="`depth_kind`"):
        monocular.load_network(str(folder), device="cpu")


@pytest.mark.parametrize("name", ["depth_anything", "dpt", "glpn"])
def test_predictions_are_those_of_transformers_and_nothing_is_printed(
    monocular, name, saved, transformers, processor_of, photographs, capfd
):
    network = transformers.AutoModelForDepthEstimation.from_pretrained(saved[name])
    with torch.no_grad():
        outputs = network(**processor_of(saved[name])(photographs, return_tensors="pt"))
    capfd.readouterr()
    ours = monocular.load_network(str(saved[name]), device="cpu")
    for photograph, expected in zip(photographs, outputs.predicted_depth, strict=True):
        depth = ours(photograph)
        wanted = torch.nn.functional.interpolate(expected[None, None], (60, 90), mode="bicubic")
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, wanted[0, 0], atol=1e-5)
        assert np.ptp(depth) > 0.01  # not an empty comparison
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", SAVED)
def test_a_map_lies_on_its_photograph(monocular, name, saved, processor_of, identity, ramp):
    """Padding is removed and centres stay in place, to a fifth of a pixel along either axis.

    ZoeDepth's processor resizes corners onto corners, which moves its own input by half a pixel.
    """
    if name == "zoedepth":
        pytest.importorskip("torchvision")
    processor, network = processor_of(saved[name]), identity(saved[name])
    depth = monocular.DepthNetwork(processor, network, monocular.Meaning("z", "made"), CPU)(ramp)
    assert depth.shape == ramp.shape[:2]
    off = np.abs(depth - ramp[..., 0])[8:-8, 8:-8].mean()
    assert off < (1.2 if name == "zoedepth" else 0.4)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("config.json", b"{"),
        ("config.json", None),
        ("config.json", b'{"model_type": "bert"}'),
        ("config.json", b'{"model_type": "unheard"}'),
        ("model.safetensors", None),
        ("model.safetensors", b"0123456789"),
        ("preprocessor_config.json", None),
        ("preprocessor_config.json", b"[1"),
    ],
)
def test_a_damaged_folder_raises_one_error(monocular, file, content, saved, tmp_path):
    folder = shutil.copytree(saved["depth_anything"], tmp_path / "copy")
    with pytest.raises(SceneFormatError, match="a file"):
        monocular.load_network(str(folder / file))
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_bytes(content)
    with pytest.raises(SceneFormatError, match=str(folder)) as caught:
        monocular.load_network(str(folder), device="cpu")
    assert "\n" not in str(caught.value)


def test_missing_weights_are_refused_except_those_that_dpt_never_uses(
    monocular, saved, tmp_path, photographs
):
    """Which the files that Intel published omit."""
    unused = "neck.fusion_stage.layers.0.residual_layer1."
    for name, omitted in (("depth_anything", "head."), ("dpt", unused)):
        folder = shutil.copytree(saved[name], tmp_path / name)
        weights = load_file(folder / "model.safetensors")
        kept = {key: value for key, value in weights.items() if not key.startswith(omitted)}
        assert len(kept) < len(weights)
        save_file(kept, folder / "model.safetensors")
    with pytest.raises(SceneFormatError, match=r"head\.conv1\.bias"):
        monocular.load_network(str(tmp_path / "depth_anything"), device="cpu")
    ours, whole = (
        monocular.load_network(str(f), device="cpu") for f in (tmp_path / "dpt", saved["dpt"])
    )
    np.testing.assert_allclose(ours(photographs[0]), whole(photographs[0]), atol=1e-5)


@pytest.mark.parametrize("model", ["nobody/Depth-Nothing-hf", "nothing", "a/b/c", "../x"])
def test_a_network_that_is_not_local_is_not_downloaded(monocular, model, monkeypatch, tmp_path):
    def refuse(*_, **__):
        raise AssertionError("a connection was tried")

    for name in ("connect", "connect_ex"):
        monkeypatch.setattr(socket.socket, name, refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneNotFoundError) as caught:
        monocular.load_network(model)
    name = model if model.startswith("nobody") else "depth-anything/Depth-Anything-V2-Small-hf"
    assert f"hf download {name} --local-dir {name.partition('/')[2]} " in str(caught.value)


def test_an_id_is_found_in_the_cache(monocular, saved, tmp_path, monkeypatch):
    entry = tmp_path / "models--me--tiny"
    shutil.copytree(saved["dpt"], entry / "snapshots" / ("0" * 40))
    (entry / "refs").mkdir()
    (entry / "refs" / "main").write_text("0" * 40)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    assert monocular.load_network("me/tiny", device="cpu").meaning.kind == "inverse"


@pytest.mark.skipif(
    importlib.util.find_spec("torchvision") is not None, reason="torchvision is here"
)
def test_a_processor_that_needs_torchvision_is_refused_without(monocular, saved, tmp_path):
    with pytest.raises(MissingDependencyError, match="torchvision"):
        monocular.load_network(str(saved["zoedepth"]), device="cpu")
    folder = shutil.copytree(saved["depth_anything"], tmp_path / "copy")
    (folder / "config.json").write_text('{"model_type": "depth_pro"}')
    processor = {"image_processor_type": "DepthProImageProcessor"}
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    with pytest.raises(MissingDependencyError, match="torchvision"):
        monocular.load_network(str(folder), device="cpu")


@pytest.mark.parametrize(
    ("error", "raised"),
    [
        (torch.cuda.OutOfMemoryError("CUDA out of memory."), ParameterError),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), ParameterError),
        (RuntimeError("sizes of tensors must match"), SceneFormatError),
    ],
)
def test_a_network_that_fails_raises_one_error(
    monocular, error, raised, saved, processor_of, identity, ramp, monkeypatch
):
    def fail(*_, **__):
        raise error

    monkeypatch.setattr(identity, "forward", fail)
    network = identity(saved["dpt"])
    with pytest.raises(raised):
        monocular.DepthNetwork(
            processor_of(saved["dpt"]), network, monocular.Meaning("z", "made"), CPU
        )(ramp)


# A scene's photographs through a network ----------------------------------------------------------


class Brightness:
    """A network that takes bright for near, remembers what it was asked, and fails twice."""

    def __init__(self, meaning):
        self.meaning, self.asked = meaning, []

    def __call__(self, image):
        self.asked.append(image.shape[:2])
        values = image.mean(axis=2).astype(np.float32) + 1
        failing = {2: 7.0, 3: np.inf}.get(len(self.asked))
        return values if failing is None else np.full_like(values, failing)


@pytest.fixture
def network(monocular):
    return Brightness(monocular.Meaning("inverse", "made"))


@pytest.fixture
def own(exact, tmp_path):
    """A copy of the room that a test may spoil."""
    return load_scene(shutil.copytree(exact.source.image_dir.parent, tmp_path / "own"))


def test_every_image_gets_a_map_that_the_reader_finds(monocular, own, network, tmp_path):
    stages = []
    first, second, *rest = own.images
    folder = own.source.image_dir
    for image, name in ((first, "left/a.png"), (second, "right/a.png")):
        (folder / name).parent.mkdir()
        shutil.move(folder / image.name, folder / name)
    with PilImage.open(folder / rest[0].name) as picture:
        smaller = picture.resize((40, 30))
    smaller.save(folder / rest[0].name)
    renamed = (replace(first, name="left/a.png"), replace(second, name="right/a.png"), *rest[:3])
    scene = own.replace(images=renamed)
    report = monocular.estimate_depths(
        scene, network, tmp_path / "maps", max_size=80, progress=lambda *each: stages.append(each)
    )
    sizes = {image.name: (80, 60) for image in renamed} | {rest[0].name: (40, 30)}
    failed = sorted(sizes)[1:3]
    assert (report.sizes, report.flat) == (sizes, tuple(failed))
    assert set(network.asked) == {(60, 80), (30, 40)}
    depths = find_depths(scene, tmp_path / "maps")
    assert set(depths) == set(sizes)
    for name in set(sizes) - set(failed):
        with PilImage.open(folder / name) as picture:
            shown = picture.convert("RGB").resize(sizes[name], PilImage.Resampling.BICUBIC)
        assert depths.read(name).kind == "inverse"
        np.testing.assert_allclose(
            depths.read(name).values, np.asarray(shown).mean(2) + 1, rtol=1e-6
        )
    assert np.isnan(depths.read(failed[1]).values).all()
    assert ("check images", 1.0) in stages
    assert stages[-1] == ("predict depth", 1.0)


@pytest.mark.parametrize("damage", ["cut short", "of another shape", "text"])
def test_a_bad_photograph_stops_before_the_network_is_run(
    monocular, damage, own, network, tmp_path
):
    path = own.source.image_dir / max(image.name for image in own.images)
    whole = path.read_bytes()
    path.unlink()
    if damage == "of another shape":
        PilImage.new("RGB", (60, 80)).save(path)
    else:
        path.write_bytes(whole[:-100] if damage == "cut short" else b"not an image")
    with pytest.raises((SceneFormatError, SceneNotFoundError), match=path.name):
        monocular.estimate_depths(own, network, tmp_path / "maps")
    assert not network.asked
    assert not (tmp_path / "maps").exists()


def test_maps_are_never_written_into_the_scene(monocular, exact, network):
    folder = exact.source.image_dir.parent
    for output in (folder, folder / "images" / "maps"):
        with pytest.raises(OutputError):
            monocular.estimate_depths(exact, network, output)
    assert not network.asked
