"""Networks in ONNX: how their input is made, where their maps lie, and what is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

pytest.importorskip("onnxruntime", reason="needs splatseed[depth]")
pytest.importorskip("onnx", reason="the tests write their own files")

import onnx

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.monocular import Preparation, load_network
from splatseed.monocular.preparation import InputForm

from ..networks import onnx_sum

IDENTITY = Preparation(1, 1, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
MEAN, STD = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])


def _expected(image, mean=MEAN, std=STD):
    """Red + 2 green + 4 blue of the image as a network sees it."""
    return ((image / 255 - mean) / std) @ [1, 2, 4]


@pytest.mark.parametrize(
    "form",
    [
        {},
        {"shape": (1, 3, "h", "w")},
        {"shape": (2, 3, 28, 42)},
        {"shape": ("b", "c", 28, "w")},
        {"channel_axis": True},
        {"half": True},
    ],
)
@pytest.mark.parametrize("count", [1, 3])
def test_values_are_those_of_the_formula(form, count, rng, tmp_path):
    """At a size that needs no resizing, whatever the file fixes and whatever it leaves open."""
    path = onnx_sum(tmp_path / "a.onnx", **form)
    images = [rng.integers(0, 256, (28, 42, 3), dtype=np.uint8) for _ in range(count)]
    network = load_network(
        str(path), kind="z", device="cpu", preparation=Preparation(input_size=28)
    )
    predicted = network(images)
    assert len(predicted) == count
    for depth, image in zip(predicted, images, strict=True):
        assert depth.dtype == np.float32
        np.testing.assert_allclose(depth, _expected(image), atol=0.05 if form.get("half") else 1e-4)


@pytest.mark.parametrize("factor", [1, 2])
@pytest.mark.parametrize("sides", [("h", "w"), (56, 98)])
def test_a_map_lies_on_its_photograph(factor, sides, ramp, tmp_path):
    """A network that sees 56 rows of 77 and answers in half as many: still where it belongs."""
    path = onnx_sum(tmp_path / "a.onnx", shape=(1, 3, *sides), factor=factor)
    said = Preparation(56, 14, (0.0, 0.0, 0.0), (7 / 255, 7 / 255, 7 / 255))
    (depth,) = load_network(str(path), kind="z", device="cpu", preparation=said)([ramp])
    inner = (slice(8, -8), slice(8, -8))
    # The toy network looks at one of each 2 x 2 pixels, half a pixel of 56 up and left of its
    # centre.
    expected = ramp[..., 0] - (factor - 1) * 0.5 * (
        77 / 56 + 118 / (sides[1] if sides[1] == 98 else 84)
    )
    assert np.abs(depth - expected)[inner].mean() < 0.35


def test_what_lies_beside_the_file_or_above_it_is_used(rng, tmp_path):
    (tmp_path / "onnx").mkdir()
    path = onnx_sum(tmp_path / "onnx" / "model.onnx")
    config = {"model_type": "depth_anything", "depth_estimation_type": "metric"}
    (tmp_path / "config.json").write_text(json.dumps(config))
    processor = {"size": {"height": 20, "width": 20}, "ensure_multiple_of": 10}
    processor |= {"image_mean": [0.5] * 3, "image_std": [0.25] * 3}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(processor))
    image = rng.integers(0, 256, (20, 30, 3), dtype=np.uint8)
    network = load_network(str(path), device="cpu")
    assert network.meaning.kind == "z"
    np.testing.assert_allclose(network([image])[0], _expected(image, 0.5, 0.25), atol=1e-4)
    said = Preparation(mean=(0.0, 0.0, 0.0))
    predicted = load_network(str(path), device="cpu", preparation=said)([image])[0]
    np.testing.assert_allclose(predicted, _expected(image, 0.0, 0.25), atol=1e-4)


def test_a_processor_without_colours_is_believed(rng, tmp_path):
    path = onnx_sum(tmp_path / "model.onnx")
    processor = {"do_normalize": False, "size": 14, "image_mean": [0.5] * 3}
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(processor))
    image = rng.integers(0, 256, (14, 14, 3), dtype=np.uint8)
    (predicted,) = load_network(str(path), kind="z", device="cpu")([image])
    np.testing.assert_allclose(predicted, _expected(image, 0.0, 1.0), atol=1e-4)


@settings(deadline=None, max_examples=60)
@given(
    st.integers(8, 3000), st.integers(8, 3000), st.integers(100, 600), st.sampled_from([1, 14, 32])
)
def test_sides_are_those_of_dpts_own_processor(height, width, size, multiple):
    module = pytest.importorskip("transformers.models.dpt.image_processing_pil_dpt")
    theirs = module.get_resize_output_image_size(
        np.broadcast_to(np.uint8(0), (3, height, width)), (size, size), True, multiple
    )
    if min(theirs.height, theirs.width):  # theirs can be 0, which nothing can be resized to
        ours = InputForm(size=size, multiple=multiple).sides(height, width)
        assert ours == (theirs.height, theirs.width)


def test_values_are_those_of_dpts_own_processor(photographs):
    transformers = pytest.importorskip("transformers", reason="needs splatseed[depth]")
    form = InputForm(size=56)
    processor = transformers.DPTImageProcessorPil(
        size={"height": 56, "width": 56},
        keep_aspect_ratio=True,
        ensure_multiple_of=14,
        image_mean=form.mean,
        image_std=form.std,
    )
    theirs = np.asarray(processor(photographs[:1], return_tensors="np")["pixel_values"][0])
    ours = form.values(photographs[0], *form.sides(60, 90))
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")
@pytest.mark.filterwarnings("ignore::torch.jit.TracerWarning")
def test_an_exported_network_predicts_what_the_original_does(saved, photographs, tmp_path):
    torch = pytest.importorskip("torch")
    original = load_network(str(saved("depth_anything")), device="cpu")

    class OneTensor(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.network = original._network

        def forward(self, pixel_values):
            return self.network(pixel_values=pixel_values).predicted_depth

    given = (torch.zeros(1, 3, 56, 84),)
    torch.onnx.export(OneTensor(), given, tmp_path / "a.onnx", dynamo=False, opset_version=17)
    exported = load_network(str(tmp_path / "a.onnx"), kind="inverse", device="cpu")
    for predicted, expected in zip(exported(photographs), original(photographs), strict=True):
        np.testing.assert_allclose(predicted, expected, atol=1e-4)
        assert np.ptp(expected) > 0.1


def test_a_kind_that_nothing_tells_is_asked_for(tmp_path):
    path = onnx_sum(tmp_path / "a.onnx")
    with pytest.raises(ParameterError, match=r"what a\.onnx predicts; found no config\.json"):
        load_network(str(path))


@pytest.mark.parametrize("content", [b"", b"not an onnx file", b"\x08\x07" * 50])
def test_a_damaged_file_is_one_error(content, tmp_path):
    (tmp_path / "a.onnx").write_bytes(content)
    with pytest.raises(SceneFormatError, match=r"a\.onnx to be a depth network in ONNX") as caught:
        load_network(str(tmp_path / "a.onnx"), kind="z")
    assert "\n" not in str(caught.value)


def test_a_missing_file_says_which_command_fetches_one(tmp_path):
    with pytest.raises(SceneNotFoundError, match="hf download onnx-community/"):
        load_network(str(tmp_path / "a.onnx"), kind="z")


@pytest.mark.parametrize("shape", [(1, 4, 28, 28), ("b", 28, 28, 3), ("b", 3, "h")])
def test_an_input_of_another_form_is_refused(shape, tmp_path):
    path = tmp_path / "a.onnx"
    image = onnx.helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, shape)
    depth = onnx.helper.make_tensor_value_info("depth", onnx.TensorProto.FLOAT, shape)
    node = onnx.helper.make_node("Identity", ["image"], ["depth"])
    _save(path, [node], [image], [depth])
    with pytest.raises(SceneFormatError, match=r"an input of|inputs tensor"):
        load_network(str(path), kind="z")


@pytest.mark.parametrize(
    ("shape", "said"), [(("n",), "outputs depth"), (("b", 3, "h", "w"), r"output of \[1, 3")]
)
def test_an_output_of_another_form_is_refused(shape, said, tmp_path):
    path, free = tmp_path / "a.onnx", ("b", 3, "h", "w")
    image = onnx.helper.make_tensor_value_info("image", onnx.TensorProto.FLOAT, free)
    depth = onnx.helper.make_tensor_value_info("depth", onnx.TensorProto.FLOAT, shape)
    shape_node = onnx.helper.make_node("Shape", ["image"], ["sizes"])
    flat = onnx.helper.make_node("Cast", ["sizes"], ["depth"], to=onnx.TensorProto.FLOAT)
    same = onnx.helper.make_node("Identity", ["image"], ["depth"])
    _save(path, [shape_node, flat] if len(shape) == 1 else [same], [image], [depth])
    with pytest.raises(SceneFormatError, match=said):
        load_network(str(path), kind="z")([np.zeros((14, 14, 3), np.uint8)])


def _save(path, nodes, inputs, outputs):
    graph = onnx.helper.make_graph(nodes, "made", inputs, outputs)
    model = onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9
    )
    onnx.save(model, path)


def test_an_input_that_does_not_fit_names_the_flags(tmp_path):
    path = onnx_sum(tmp_path / "a.onnx", factor=20)
    network = load_network(str(path), kind="z", device="cpu", preparation=IDENTITY)
    with pytest.raises(ParameterError, match="--input-size and --input-multiple"):
        network([np.zeros((9, 9, 3), np.uint8)])


@pytest.mark.parametrize(
    "said",
    [
        {"input_size": 0},
        {"input_multiple": -1},
        {"std": (1.0, 0.0, 1.0)},
        {"mean": (float("nan"), 0.0, 0.0)},
    ],
)
def test_numbers_out_of_range_are_refused(said):
    with pytest.raises(ParameterError, match=r"--(input-size|input-multiple|mean|std)"):
        Preparation(**said)


@pytest.mark.parametrize(
    "content",
    [
        b"{",
        b"[]",
        b"\xff\xfe1",
        b'{"size": []}',
        b'{"image_mean": [1, 2]}',
        b'{"image_std": [0, 1, 1]}',
    ],
)
def test_a_damaged_description_is_one_error(content, tmp_path):
    path = onnx_sum(tmp_path / "a.onnx")
    (tmp_path / "preprocessor_config.json").write_bytes(content)
    with pytest.raises(SceneFormatError, match=r"preprocessor_config\.json"):
        load_network(str(path), kind="z")
