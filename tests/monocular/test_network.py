"""Networks in transformers' format: what they predict, where, and what is refused."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch", reason="networks of transformers need PyTorch")
pytest.importorskip("transformers", reason="needs splatseed[depth]")

import torch
import transformers
from safetensors.torch import load_file, save_file

from splatseed.errors import (
    MissingDependencyError,
    ParameterError,
    SceneFormatError,
    SceneNotFoundError,
)
from splatseed.monocular.network import DepthNetwork, Meaning, load_network

from ..networks import SAVED

KINDS = {
    "depth_anything": "inverse",
    "depth_anything_metric": "z",
    "dpt": "inverse",
    "dpt_on_dinov2": "z",
    "glpn": "z",
    "zoedepth": "z",
}


def _scaled(depth, size):
    return torch.nn.functional.interpolate(depth[None, None], size, mode="bilinear")[0, 0]


@pytest.mark.parametrize("name", SAVED)
def test_what_a_network_predicts_is_read_from_its_config(name, saved):
    assert load_network(str(saved(name)), device="cpu").meaning.kind == KINDS[name]


def test_the_user_says_where_the_config_does_not(saved, tmp_path):
    assert load_network(str(saved("dpt")), kind="ray", device="cpu").meaning.kind == "ray"
    folder = _copy(saved, tmp_path)
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(
        json.dumps({**config, "model_type": "prompt_depth_anything"})
    )
    with pytest.raises(ParameterError, match="--depth-kind"):
        load_network(str(folder), device="cpu")


@pytest.mark.parametrize("name", ["depth_anything", "depth_anything_metric", "dpt", "glpn"])
def test_predictions_are_those_of_transformers_at_the_photographs_size(name, saved, photographs):
    processor = transformers.AutoImageProcessor.from_pretrained(saved(name), backend="pil")
    network = transformers.AutoModelForDepthEstimation.from_pretrained(saved(name))
    with torch.no_grad():
        outputs = network(**processor(photographs, return_tensors="pt"))
    ours = load_network(str(saved(name)), device="cpu")
    for photograph, expected in zip(photographs, outputs.predicted_depth, strict=True):
        depth = ours(photograph)
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, _scaled(expected, (60, 90)), atol=1e-5)
        assert np.ptp(depth) > 0.01  # not an empty comparison


class _SeesItself(torch.nn.Module):
    """Predicts the first channel of its input: where a pixel of a map lies can then be read off
    it."""

    def __init__(self, config, processor):
        super().__init__()
        self.config = config
        normalises = processor.do_normalize
        self.mean = processor.image_mean[0] if normalises else 0.0
        self.std = processor.image_std[0] if normalises else 1.0

    def forward(self, pixel_values):
        return SimpleNamespace(predicted_depth=(pixel_values[:, 0] * self.std + self.mean) * 255)


@pytest.mark.parametrize(
    ("name", "off"), [(name, 0.3) for name in SAVED if "zoe" not in name] + [("zoedepth", 1.2)]
)
def test_a_map_lies_on_its_photograph(name, off, saved, ramp):
    """Padding is taken off and centres stay in place, to ``off`` pixels along either axis.

    ZoeDepth's processor resizes corners onto corners, which moves its own input by half a pixel.
    """
    processor = transformers.AutoImageProcessor.from_pretrained(saved(name), backend="pil")
    config = transformers.AutoConfig.from_pretrained(saved(name))
    network = DepthNetwork(
        processor, _SeesItself(config, processor), Meaning("z", "made"), torch.device("cpu")
    )
    depth = network(ramp)
    assert depth.shape == ramp.shape[:2]
    inner = (slice(8, -8), slice(8, -8))
    assert np.abs(depth - ramp[..., 0])[inner].mean() < off


def test_padding_is_what_the_processor_itself_would_add(saved, ramp):
    processor = transformers.AutoImageProcessor.from_pretrained(
        saved("dpt_on_dinov2"), backend="pil"
    )
    seen = []
    config = transformers.AutoConfig.from_pretrained(saved("dpt_on_dinov2"))
    network = _SeesItself(config, processor)
    network.register_forward_pre_hook(lambda _, __, given: seen.append(given), with_kwargs=True)
    DepthNetwork(processor, network, Meaning("z", "made"), torch.device("cpu"))(ramp)
    expected = processor([ramp], return_tensors="pt")["pixel_values"]
    assert expected.shape[2:] == (84, 126)
    torch.testing.assert_close(seen[0]["pixel_values"], expected)


def test_depth_pro_leaves_its_maps_to_its_processor():
    """Its scale depends on the field of view that it predicts, as its own post-processing knows."""

    class Processor:
        do_pad = False

        def __call__(self, images, **_):
            return {"pixel_values": np.zeros((len(images), 3, 4, 4), np.float32)}

        def post_process_depth_estimation(self, outputs, target_sizes):
            sizes = zip(outputs.field_of_view, target_sizes, strict=True)
            return [{"predicted_depth": torch.full(size, float(fov))} for fov, size in sizes]

    class Network(torch.nn.Module):
        def forward(self, pixel_values):
            fov = torch.tensor([40])
            return SimpleNamespace(predicted_depth=pixel_values[:, 0], field_of_view=fov)

    network = DepthNetwork(Processor(), Network(), Meaning("z", "made"), torch.device("cpu"))
    depth = network(np.zeros((6, 9, 3), np.uint8))
    assert depth.shape == (6, 9)
    assert (depth == 40).all()


def _copy(saved, tmp_path, name="depth_anything"):
    return shutil.copytree(saved(name), tmp_path / "copy")


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
def test_a_damaged_folder_is_one_error(file, content, saved, tmp_path):
    folder = _copy(saved, tmp_path)
    with pytest.raises(SceneFormatError, match="a file"):
        load_network(str(folder / file))
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_bytes(content)
    with pytest.raises(SceneFormatError, match=str(folder)) as caught:
        load_network(str(folder), device="cpu")
    assert "\n" not in str(caught.value)


def test_a_network_with_random_weights_is_refused(saved, tmp_path):
    folder = _copy(saved, tmp_path)
    weights = load_file(folder / "model.safetensors")
    save_file(
        {k: v for k, v in weights.items() if not k.startswith("head.")},
        folder / "model.safetensors",
    )
    with pytest.raises(SceneFormatError, match=r"head\.conv1\.bias"):
        load_network(str(folder), device="cpu")
    weights["head.conv1.weight"] = torch.zeros(7, 7, 3, 3)  # another shape
    save_file(weights, folder / "model.safetensors")
    with pytest.raises(SceneFormatError):
        load_network(str(folder), device="cpu")


def test_weights_that_dpt_never_uses_may_be_missing(saved, tmp_path, photographs):
    """As in the files that Intel published."""
    folder = _copy(saved, tmp_path, "dpt")
    weights = load_file(folder / "model.safetensors")
    unused = "neck.fusion_stage.layers.0.residual_layer1."
    kept = {key: value for key, value in weights.items() if not key.startswith(unused)}
    assert len(kept) < len(weights)
    save_file(kept, folder / "model.safetensors")
    ours, whole = (load_network(str(each), device="cpu") for each in (folder, saved("dpt")))
    np.testing.assert_allclose(ours(photographs[0]), whole(photographs[0]), atol=1e-5)


@pytest.mark.usefixtures("offline")
@pytest.mark.parametrize("model", ["nobody/Depth-Nothing-hf", "nothing", "./gone", "a/b/c", "../x"])
def test_a_network_that_is_not_here_is_never_looked_for_elsewhere(model, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SceneNotFoundError) as caught:
        load_network(model)
    name = model if model.startswith("nobody") else "depth-anything/Depth-Anything-V2-Small-hf"
    folder = name.partition("/")[2]
    assert f"hf download {name} --local-dir {folder} and pass --model {folder}" in str(caught.value)


def test_an_id_is_found_in_the_cache(saved, tmp_path):
    """In a process of its own: where the cache is, is settled as Hugging Face's package loads."""
    entry = tmp_path / "hub" / "models--me--tiny"
    shutil.copytree(saved("dpt"), entry / "snapshots" / ("0" * 40))
    (entry / "refs").mkdir()
    (entry / "refs" / "main").write_text("0" * 40)
    code = "from splatseed.monocular.network import load_network as load"
    code += "; print(load('me/tiny').meaning.kind)"
    environment = {**os.environ, "HF_HOME": str(tmp_path), "HF_HUB_CACHE": str(tmp_path / "hub")}
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, text=True, env=environment
    )
    assert run.stdout.strip() == "inverse"


@pytest.mark.skipif(
    importlib.util.find_spec("torchvision") is not None, reason="torchvision is here"
)
def test_a_processor_that_needs_torchvision_says_so(saved, tmp_path):
    folder = _copy(saved, tmp_path)
    (folder / "config.json").write_text('{"model_type": "depth_pro"}')
    processor = {"image_processor_type": "DepthProImageProcessor"}
    (folder / "preprocessor_config.json").write_text(json.dumps(processor))
    with pytest.raises(MissingDependencyError, match="pip install torchvision"):
        load_network(str(folder), device="cpu")


@pytest.mark.parametrize(
    ("error", "raised", "said"),
    [
        (torch.cuda.OutOfMemoryError("CUDA out of memory."), ParameterError, "--max-size"),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), ParameterError, "--max-size"),
        (RuntimeError("sizes of tensors must match"), SceneFormatError, "tensors must match"),
    ],
)
def test_a_network_that_fails_is_one_error(error, raised, said, saved, ramp):
    class Failing(torch.nn.Module):
        config = transformers.AutoConfig.from_pretrained(saved("dpt"))

        def forward(self, **_):
            raise error

    processor = transformers.AutoImageProcessor.from_pretrained(saved("dpt"), backend="pil")
    network = DepthNetwork(processor, Failing(), Meaning("z", "made"), torch.device("cpu"))
    with pytest.raises(raised, match=said):
        network(ramp)


def test_loading_and_predicting_say_nothing(saved, photographs, capfd):
    load_network(str(saved("zoedepth")), device="cpu")(photographs[0])
    assert capfd.readouterr() == ("", "")
