"""Depth networks in Hugging Face's format, run by transformers and PyTorch.

Notation: a network sees a photograph within a *frame*: pixels [height, width] of the frame's
[full_height, full_width], from (top, left) on; the rest is padding that the network asked for.
Promise: nothing is downloaded and no code from a model's folder is run; a network whose weights are
not all in its file is refused rather than run with random ones; transformers' logs stay silent.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from torch import Tensor
from torch.nn.functional import interpolate, pad

from splatseed.depthmap import DepthKind
from splatseed.errors import (
    MissingDependencyError,
    ParameterError,
    SceneFormatError,
    SceneNotFoundError,
    SplatseedError,
)
from splatseed.literal import quoted
from splatseed.monocular.network import DeviceName, Meaning, meaning_of, one_line
from splatseed.process.torch_device import pick_torch_device

EXAMPLE = "depth-anything/Depth-Anything-V2-Small-hf"
_ID = re.compile(r"\w[\w.-]*/\w[\w.-]*")
_UNUSED = re.compile(r"fusion_stage\.layers\.0\.residual_layer1\.")
"""Weights that DPT has but never uses; Intel's files omit them."""
_ZOE_MARGIN = 3
"""ZoeDepth pads a photograph by mirroring this times the square root of half a side's pixels."""
_LOCAL = {"local_files_only": True, "trust_remote_code": False}


class Frame(NamedTuple):
    """Where the photograph lies within what the network sees."""

    full_height: int
    full_width: int
    top: int
    left: int
    height: int
    width: int


class HuggingFaceNetwork:
    """A network of transformers' auto class for depth, with its image processor.

    Args:
        processor: Makes the network's input.
        network: A model whose output has ``predicted_depth``.
        meaning: What it predicts.
        device: Where to run it.
    """

    def __init__(
        self, processor: Any, network: Any, meaning: Meaning, device: torch.device
    ) -> None:
        self.meaning = meaning
        self._processor = processor
        self._network = network.eval().to(device)
        self._device = device

    @property
    def device(self) -> str:
        """Where it runs, in words."""
        if self._device.type == "cuda":
            return torch.cuda.get_device_name(self._device)
        return f"CPU, {torch.get_num_threads()} threads"

    @torch.inference_mode()
    def __call__(
        self, images: Sequence[UInt8[np.ndarray, "H W 3"]]
    ) -> list[Float32[np.ndarray, "H W"]]:
        """Predict for photographs of one size (sRGB), at their size.

        Predictions are resized to the photograph bilinearly, so that no value lies outside those
        predicted, and without the padding that some networks ask for.

        Raises:
            ParameterError: The batch does not fit into the GPU's memory.
            SceneFormatError: The network does not run on such an image.
        """
        size = images[0].shape[:2]
        values, frame = self._prepare(images)
        outputs = self._run(values)
        if getattr(outputs, "field_of_view", None) is not None:  # Depth Pro's scale depends on it
            depths = self._processor.post_process_depth_estimation(
                outputs, target_sizes=[size] * len(images)
            )
            return [each["predicted_depth"].float().cpu().numpy() for each in depths]
        depth = _unframe(outputs.predicted_depth[:, None].float(), frame)
        return list(_scaled(depth, size)[:, 0].cpu().numpy())

    def _prepare(
        self, images: Sequence[UInt8[np.ndarray, "H W 3"]]
    ) -> tuple[Float[Tensor, "B 3 h w"], Frame | None]:
        """The network's input, and where the photographs lie in it; None: they fill it."""
        processor, height, width = self._processor, *images[0].shape[:2]
        divisor = getattr(processor, "size_divisor", None)
        pads = bool(getattr(processor, "do_pad", False))
        if pads and divisor:  # done here: the processor does not report how much
            return _padded(self._process(images, do_pad=False), divisor)
        values = self._process(images)
        if pads and self._network.config.model_type == "zoedepth":
            top, left = (int(math.sqrt(side / 2) * _ZOE_MARGIN) for side in (height, width))
            return values, Frame(height + 2 * top, width + 2 * left, top, left, height, width)
        return values, None

    def _process(
        self, images: Sequence[UInt8[np.ndarray, "H W 3"]], **options: bool
    ) -> Float[Tensor, "B 3 h w"]:
        made = self._processor(
            images=list(images),
            return_tensors="pt",
            input_data_format="channels_last",
            **options,
        )
        return torch.as_tensor(made["pixel_values"])

    def _run(self, values: Float[Tensor, "B 3 h w"]) -> Any:
        try:
            return self._network(pixel_values=values.to(self._device))
        except (RuntimeError, ValueError) as error:
            raise _failed(error, values) from error


def load_hugging_face(
    model: str, *, kind: DepthKind | None = None, device: DeviceName = "auto"
) -> HuggingFaceNetwork:
    """Load a network that is on this machine.

    Args:
        model: A folder with ``config.json``, ``preprocessor_config.json`` and weights, or the id of
            a model that Hugging Face's cache holds.
        kind: What it predicts; None: what its configuration says.
        device: Where to run it; auto takes a GPU if PyTorch sees one.

    Raises:
        SceneNotFoundError: It is not on this machine; says which command fetches it.
        SceneFormatError: It is not a depth network, or is damaged.
        ParameterError: There is no such device, or nothing says what it predicts.
        MissingDependencyError: Its image processor needs torchvision, which is absent.
    """
    where = pick_torch_device(device, "--device")
    _check_folder(model)
    with _silent():
        meaning = meaning_of(_read_config(model).to_dict(), model, kind)
        processor, network = _load(model)
    return HuggingFaceNetwork(processor, network, meaning, where)


def _failed(error: Exception, values: Float[Tensor, "B 3 h w"]) -> SplatseedError:
    """The error for a network that failed.

    PyTorch's memory errors on the CPU contain "allocate".
    """
    batch, _, height, width = values.shape
    if isinstance(error, torch.cuda.OutOfMemoryError) or "allocate" in str(error):
        return ParameterError(
            f"enough memory for {batch} images of {width} x {height} at once",
            found=one_line(error).partition(". ")[0],
            fix="Pass a smaller --batch or --max-size, or another --device.",
        )
    return SceneFormatError(
        f"a network that takes images of {width} x {height} pixels",
        found=one_line(error),
        fix="Its preprocessor_config.json may belong to another network.",
    )


def _check_folder(model: str) -> None:
    """Refuse a path on disk that holds no network."""
    path = Path(model)
    if path.is_dir() and not (path / "config.json").is_file():
        raise _misfit(model, "no config.json in it")
    if path.is_file():
        raise _misfit(model, "a file that is not .onnx")


def _read_config(model: str) -> Any:
    """The configuration of a network for depth, from its folder or from Hugging Face's cache."""
    from transformers import MODEL_FOR_DEPTH_ESTIMATION_MAPPING, AutoConfig  # noqa: PLC0415  (loads with its use)

    try:
        config = AutoConfig.from_pretrained(model, **_LOCAL)
    except Exception as error:  # transformers raises errors of many libraries
        if Path(model).is_dir():
            raise _misfit(model, one_line(error)) from error
        raise _absent(model) from error
    if type(config) not in MODEL_FOR_DEPTH_ESTIMATION_MAPPING:
        raise _misfit(model, f"a network of type {config.model_type}, which is not for depth")
    return config


def _absent(model: str) -> SceneNotFoundError:
    return SceneNotFoundError(
        f"the depth network {model} on this machine",
        found="neither a folder of that name nor a copy in Hugging Face's cache",
        fix=f"splatseed downloads nothing by itself. {_fetch(model)}",
    )


def _fetch(model: str) -> str:
    """How to get a network: this one if its name is that of a published one, else a small one."""
    name = model if _ID.fullmatch(model) else EXAMPLE
    folder = name.rpartition("/")[2]
    return f"Run: hf download {name} --local-dir {folder} and pass --model {folder}."


def _load(model: str) -> tuple[Any, Any]:
    """The image processor and the network, from local files only."""
    from transformers import (  # noqa: PLC0415  (seconds to import)
        AutoImageProcessor,
        AutoModelForDepthEstimation,
    )

    try:
        # Pillow's resizing, with or without torchvision: the same maps on every machine.
        processor = AutoImageProcessor.from_pretrained(model, backend="pil", **_LOCAL)
        network, loading = AutoModelForDepthEstimation.from_pretrained(
            model, dtype=torch.float32, output_loading_info=True, **_LOCAL
        )
    except MemoryError:
        raise
    except Exception as error:  # transformers raises errors of many libraries
        raise _unloadable(model, error) from error
    _check_complete(model, network, loading["missing_keys"])
    return processor, network


def _unloadable(model: str, error: Exception) -> SplatseedError:
    if "torchvision" in str(error).lower() and find_spec("torchvision") is None:
        return MissingDependencyError(
            f"torchvision, which the image processor of {model} needs",
            found="none",
            fix="Install it for your version of PyTorch: "
            f"{quoted(sys.executable or 'python')} -m pip install torchvision.",
        )
    return _misfit(model, one_line(error))


def _check_complete(model: str, network: Any, missing: set[str]) -> None:
    """Refuse a network if some of its weights would be random."""
    parameters = {name for name, _ in network.named_parameters()}
    random = sorted(name for name in missing & parameters if not _UNUSED.search(name))
    if random:
        raise _misfit(model, f"no weights for {random[0]} and {len(random) - 1} more")


def _misfit(model: str, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{model} to be a depth network that transformers loads: config.json,"
        " preprocessor_config.json and weights",
        found=found,
        fix=f"Networks in their authors' own formats (.pth, .pt) are not read. {_fetch(EXAMPLE)}",
    )


@contextmanager
def _silent() -> Iterator[None]:
    """Keep transformers' warnings and progress bars from the terminal."""
    from transformers.utils import logging  # noqa: PLC0415  (loads with its use)

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def _padded(
    values: Float[Tensor, "B 3 h w"], divisor: int
) -> tuple[Float[Tensor, "B 3 H W"], Frame]:
    """Zero-padded on both sides to multiples of ``divisor``."""
    height, width = values.shape[2:]
    down, right = (-side % divisor for side in (height, width))
    top, left = down // 2, right // 2
    frame = Frame(height + down, width + right, top, left, height, width)
    return pad(values, (left, right - left, top, down - top)), frame


def _unframe(depth: Float[Tensor, "B 1 h w"], frame: Frame | None) -> Float[Tensor, "B 1 H W"]:
    """The part of a prediction that shows the photograph."""
    if frame is None:
        return depth
    full = _scaled(depth, (frame.full_height, frame.full_width))
    return full[:, :, frame.top : frame.top + frame.height, frame.left : frame.left + frame.width]


def _scaled(depth: Float[Tensor, "B 1 h w"], size: Sequence[int]) -> Float[Tensor, "B 1 H W"]:
    return interpolate(depth, size=tuple(size), mode="bilinear", align_corners=False)
