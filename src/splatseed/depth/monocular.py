"""Depth maps by a network in Hugging Face's format, run by transformers and PyTorch.

Promise: nothing is downloaded and no code from a model's folder is run; a network whose weights are
not all in its file is refused rather than run with random ones; the meaning of its values is stated
with the evidence for it, or the user is asked. Every photograph is read to its last byte before the
network runs on the first, and the folder of maps appears whole or not at all.
"""

from __future__ import annotations

import math
import re
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Float32, UInt8
from PIL import Image as PilImage
from torch import Tensor
from torch.nn.functional import interpolate, pad

from splatseed import errors
from splatseed.depthmap import DepthKind
from splatseed.io import photograph
from splatseed.io.depth_maps import depth_folder
from splatseed.io.files import StrPath
from splatseed.io.photograph_checks import check_sizes, with_photographs
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.runtime.torch_device import DeviceName, pick_torch_device
from splatseed.scene import Scene
from splatseed.text import quoted

_EXAMPLE = "depth-anything/Depth-Anything-V2-Small-hf"
_ID = re.compile(r"\w[\w.-]*/\w[\w.-]*")
_UNUSED = re.compile(r"fusion_stage\.layers\.0\.residual_layer1\.")
"""Weights that DPT has but never uses; Intel's files omit them."""
_ZOE_MARGIN = 3
"""ZoeDepth pads a photograph by mirroring this times the square root of half a side's pixels."""
_LOCAL = {"local_files_only": True, "trust_remote_code": False}
_METRIC = {"depth_pro": "Depth Pro", "glpn": "GLPN", "tipsv2_dpt": "TIPSv2", "zoedepth": "ZoeDepth"}
"""Model types that always predict metres, and their common names."""

Size = tuple[int, int]
"""Width and height in pixels."""
_Frame = tuple[tuple[int, int], tuple[int, int, int, int]]
"""Rows and columns of what a network sees; top, left, height and width of the photograph there."""


class Meaning(NamedTuple):
    """What a network's values are, and the evidence in a few words."""

    kind: DepthKind
    reason: str


class DepthReport(NamedTuple):
    """The result of prediction."""

    sizes: Mapping[str, Size]  # of each map, by its image's name
    flat: tuple[str, ...]  # images whose map is constant, or not finite: the network failed there
    seconds: float  # wall time of the predictions


def estimate_depths(
    scene: Scene,
    network: DepthNetwork,
    output: StrPath,
    *,
    max_size: int = 1600,
    overwrite: bool = False,
    provenance: Mapping[str, object] | None = None,
    progress: Progress = silent,
) -> DepthReport:
    """Predict a depth map for every image of a scene; ``splatseed.io.find_depths`` reads them.

    A photograph whose longer side has more than ``max_size`` pixels is reduced to this before the
    network sees it, and its map, a float32 ``.npy``, has that size. ``provenance`` is how the maps
    were made, for ``splatseed.json``.

    Raises:
        SceneNotFoundError: The scene has no images, or fewer than half of the photographs.
        SceneFormatError: A photograph cannot be decoded, or differs from its camera in aspect
            ratio.
        OutputError: The folder cannot be written.
    """
    scene, output = with_photographs(scene), Path(output)
    folder, kind, flat = photograph.photograph_folder(scene), network.meaning.kind, []
    protect = (folder,) if scene.source is None else scene.source.inputs
    with depth_folder(
        output, kind, overwrite=overwrite, protect=protect, provenance=provenance
    ) as writer:
        sizes = _sizes(scene, folder, max_size, progress)
        start = time.perf_counter()
        progress("predict depth", 0.0)
        for done, (name, size) in enumerate(sizes.items(), 1):
            path = folder / name
            picture = photograph.decode_photograph(
                path, photograph.photograph_bytes(path), scene.white
            )
            if picture.size != size:
                picture = picture.resize(size, PilImage.Resampling.BICUBIC)
            values = network(np.array(picture))
            finite = np.isfinite(values)
            writer.write(name, np.where(finite, values, np.float32(np.nan)))
            if not finite.any() or np.ptp(values[finite]) == 0:
                flat.append(name)
            progress("predict depth", done / len(sizes))
    return DepthReport(sizes, tuple(flat), time.perf_counter() - start)


def _sizes(scene: Scene, folder: Path, max_size: int, progress: Progress) -> dict[str, Size]:
    """The size at which the network sees each photograph, by name, in order of names."""
    names, sizes = sorted(image.name for image in scene.images), {}
    check_sizes(scene.images, folder)
    with ThreadPoolExecutor() as pool:  # Pillow decodes outside the GIL
        checked = pool.map(lambda name: photograph.check_photograph(folder / name), names)
        for name, (width, height) in zip(names, checked, strict=True):
            factor = min(max_size / max(width, height), 1.0)
            sizes[name] = max(round(width * factor), 1), max(round(height * factor), 1)
            progress("check images", len(sizes) / len(names))
    return sizes


class DepthNetwork:
    """A network of transformers' auto class for depth, with its image processor and its meaning."""

    def __init__(
        self, processor: Any, network: Any, meaning: Meaning, device: torch.device
    ) -> None:
        self.meaning = meaning
        self._processor, self._device = processor, device
        self._network = network.eval().to(device)

    @property
    def device(self) -> str:
        """Where it runs, in words."""
        if self._device.type == "cuda":
            return torch.cuda.get_device_name(self._device)
        return f"CPU, {torch.get_num_threads()} threads"

    @torch.inference_mode()
    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
        """Predict for a photograph (sRGB), at its size.

        Predictions are resized to the photograph bilinearly, so that no value lies outside those
        predicted, and without the padding that some networks ask for.

        Raises:
            ParameterError: The photograph does not fit into memory.
            SceneFormatError: The network does not run on such an image.
        """
        size = image.shape[:2]
        values, frame = self._prepare(image)
        try:
            outputs = self._network(pixel_values=values.to(self._device))
        except (RuntimeError, ValueError) as error:
            raise _failed(error, values) from error
        if getattr(outputs, "field_of_view", None) is not None:  # Depth Pro's scale depends on it
            (made,) = self._processor.post_process_depth_estimation(outputs, target_sizes=[size])
            depth = made["predicted_depth"].float()
        else:
            depth = outputs.predicted_depth[:, None].float()
            if frame is not None:
                seen, (top, left, height, width) = frame
                depth = _scaled(depth, seen)[..., top : top + height, left : left + width]
            depth = _scaled(depth, size)[0, 0]
        return np.asarray(depth.cpu().numpy())

    def _prepare(
        self, image: UInt8[np.ndarray, "H W 3"]
    ) -> tuple[Float[Tensor, "1 3 h w"], _Frame | None]:
        """The network's input, and where the photograph lies in it; None: it fills it."""
        processor = self._processor
        given = {"images": [image], "return_tensors": "pt", "input_data_format": "channels_last"}
        pads = bool(getattr(processor, "do_pad", False))
        divisor = getattr(processor, "size_divisor", None)
        if pads and divisor:  # done here: the processor does not report how much
            values = torch.as_tensor(processor(**given, do_pad=False)["pixel_values"])
            height, width = values.shape[2:]
            down, right = -height % divisor, -width % divisor
            top, left = down // 2, right // 2
            values = pad(values, (left, right - left, top, down - top))
            return values, ((height + down, width + right), (top, left, height, width))
        values = torch.as_tensor(processor(**given)["pixel_values"])
        if not (pads and self._network.config.model_type == "zoedepth"):
            return values, None
        height, width = image.shape[:2]
        top, left = (int(math.sqrt(side / 2) * _ZOE_MARGIN) for side in (height, width))
        return values, ((height + 2 * top, width + 2 * left), (top, left, height, width))


def _scaled(depth: Float[Tensor, "1 1 h w"], size: Sequence[int]) -> Float[Tensor, "1 1 H W"]:
    return interpolate(depth, size=tuple(size), mode="bilinear", align_corners=False)


def load_network(
    model: str, *, kind: DepthKind | None = None, device: DeviceName = "auto"
) -> DepthNetwork:
    """Load a depth network that is on this machine; transformers keeps silent from then on.

    ``model`` is a folder with ``config.json``, ``preprocessor_config.json`` and weights, or the id
    of one in Hugging Face's cache; ``kind`` what it predicts, if its configuration is not to say.

    Raises:
        MissingDependencyError: transformers, or torchvision where its image processor needs it, is
            absent.
        SceneNotFoundError: It is not on this machine; says which command fetches it.
        SceneFormatError: It is not a depth network, or is damaged.
        ParameterError: There is no such device, or nothing says what it predicts.
    """
    require("transformers")
    from transformers.utils import logging  # noqa: PLC0415  (seconds to import)

    where = pick_torch_device(device, "device")
    path = Path(model)
    if path.is_file() or (path.is_dir() and not (path / "config.json").is_file()):
        raise _misfit(model, "a file" if path.is_file() else "no config.json in it")
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    meaning = _meaning_of(_read_config(model).to_dict(), model, kind)
    return DepthNetwork(*_load(model), meaning, where)


def _meaning_of(config: Mapping[str, Any], name: str, given: DepthKind | None) -> Meaning:
    """What a network predicts, by its ``config.json``, unless the user says."""
    model_type = config["model_type"]
    if given is not None:
        return Meaning(given, "as --depth-kind says")
    if model_type in _METRIC:
        return Meaning("z", f"{_METRIC[model_type]} predicts metres")
    if model_type == "depth_anything":
        if config.get("depth_estimation_type", "relative") == "metric":
            return Meaning("z", "its config says depth_estimation_type metric")
        return Meaning("inverse", "Depth Anything is relative unless its config says metric")
    if model_type == "dpt":  # published by MiDaS, and with DINOv2
        if (config.get("backbone_config") or {}).get("model_type") == "dinov2":
            return Meaning("z", "DPT on DINOv2 predicts metres")
        return Meaning("inverse", "DPT of MiDaS predicts inverse depth")
    raise errors.ParameterError(
        f"--depth-kind, to say what {name} predicts",
        found=f"a network of type {model_type!r}, which does not say",
        fix="Pass --depth-kind inverse for networks that predict disparity (MiDaS, Depth Anything"
        " without 'Metric'), --depth-kind z for those that predict metres.",
    )


def _read_config(model: str) -> Any:
    """The configuration of a network for depth, from its folder or from Hugging Face's cache."""
    import transformers  # noqa: PLC0415  (loads with its use)

    try:
        config = transformers.AutoConfig.from_pretrained(model, **_LOCAL)
    except Exception as error:  # transformers raises errors of many libraries
        if Path(model).is_dir():
            raise _misfit(model, _one_line(error)) from error
        raise errors.SceneNotFoundError(
            f"the depth network {model} on this machine",
            found="neither a folder of that name nor a copy in Hugging Face's cache",
            fix="splatseed downloads nothing by itself. "
            + _fetch(model if _ID.fullmatch(model) else _EXAMPLE),
        ) from error
    if type(config) not in transformers.MODEL_FOR_DEPTH_ESTIMATION_MAPPING:
        raise _misfit(model, f"a network of type {config.model_type}, which is not for depth")
    return config


def _load(model: str) -> tuple[Any, Any]:
    """The image processor and the network, from local files only, with all weights."""
    import transformers  # noqa: PLC0415  (seconds to import)

    try:
        # Pillow's resizing, with or without torchvision: the same maps on every machine.
        processor = transformers.AutoImageProcessor.from_pretrained(model, backend="pil", **_LOCAL)
        network, loading = transformers.AutoModelForDepthEstimation.from_pretrained(
            model, dtype=torch.float32, output_loading_info=True, **_LOCAL
        )
    except MemoryError:
        raise
    except Exception as error:  # transformers raises errors of many libraries
        if "torchvision" in str(error).lower() and find_spec("torchvision") is None:
            pip = f"{quoted(sys.executable or 'python')} -m pip install torchvision"
            raise errors.MissingDependencyError(
                f"torchvision, which the image processor of {model} needs",
                found="none",
                fix=f"Install it for your version of PyTorch: {pip}.",
            ) from error
        raise _misfit(model, _one_line(error)) from error
    parameters = {name for name, _ in network.named_parameters()}
    missing = sorted(n for n in loading["missing_keys"] & parameters if not _UNUSED.search(n))
    if missing:
        raise _misfit(model, f"no weights for {missing[0]} and {len(missing) - 1} more")
    return processor, network


def _failed(error: Exception, values: Float[Tensor, "1 3 h w"]) -> errors.SplatseedError:
    """The error for a network that failed."""
    height, width = values.shape[2:]
    # PyTorch's memory errors on the CPU contain "allocate".
    if isinstance(error, torch.cuda.OutOfMemoryError) or "allocate" in str(error):
        return errors.ParameterError(
            f"enough memory for an image of {width} x {height}",
            found=_one_line(error).partition(". ")[0],
            fix="Pass a smaller --max-size, or another --device.",
        )
    return errors.SceneFormatError(
        f"a network that takes images of {width} x {height} pixels",
        found=_one_line(error),
        fix="Its preprocessor_config.json may belong to another network.",
    )


def _misfit(model: str, found: str) -> errors.SceneFormatError:
    return errors.SceneFormatError(
        f"{model} to be a depth network that transformers loads: a folder of config.json,"
        " preprocessor_config.json and weights",
        found=found,
        fix=f"Networks in other formats (.pth, .pt, .onnx) are not read. {_fetch(_EXAMPLE)}",
    )


def _fetch(name: str) -> str:
    folder = name.rpartition("/")[2]
    return f"Run: hf download {name} --local-dir {folder} and pass --model {folder}."


def _one_line(error: Exception) -> str:
    """The first line of another library's error."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0].rstrip('.')}" if lines else type(error).__name__
