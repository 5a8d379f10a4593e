"""Depth maps by a network of transformers' pipeline for depth estimation.

Promise: nothing is downloaded and no code from a model's folder is run; a network whose weights are
not all in its file is refused rather than run with random ones. Every photograph is decoded before
the network runs on the first, and the folder of maps appears complete or not at all.
"""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import transformers
from jaxtyping import Float32, UInt8
from PIL import Image as PilImage

from splatseed import errors
from splatseed.depthmap import DepthKind
from splatseed.io.depth_maps import depth_folder
from splatseed.io.files import StrPath
from splatseed.io.photograph import check_photograph
from splatseed.io.photograph_checks import check_sizes, with_photographs
from splatseed.progress import Progress, silent
from splatseed.runtime.torch_device import DeviceName, pick_torch_device
from splatseed.scene import Scene
from splatseed.text import quoted

EXAMPLE = "depth-anything/Depth-Anything-V2-Small-hf"
LOCAL = {"local_files_only": True, "trust_remote_code": False}
UNUSED_WEIGHTS = re.compile(r"fusion_stage\.layers\.0\.residual_layer1\.")
"""Weights that DPT has but never uses; Intel's files omit them."""
METRIC = {"depth_pro": "Depth Pro", "glpn": "GLPN", "tipsv2_dpt": "TIPSv2", "zoedepth": "ZoeDepth"}
"""Model types that always predict metres, and their common names."""


class Meaning(NamedTuple):
    """Kind of a network's values, and the reason to assume it."""

    kind: DepthKind
    reason: str


class DepthReport(NamedTuple):
    """Result of ``estimate_depths``."""

    sizes: Mapping[str, tuple[int, int]]  # width and height of each map, by image name
    flat: tuple[str, ...]  # images whose map is constant or not finite: the network failed there
    seconds: float  # wall time of the predictions


class DepthNetwork:
    """A network of transformers' auto class for depth, with its image processor."""

    def __init__(
        self, processor: Any, network: Any, meaning: Meaning, device: torch.device
    ) -> None:
        self.meaning, self.device = meaning, str(device)
        self._pipeline = transformers.DepthEstimationPipeline(
            model=network, image_processor=processor, device=device
        )

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> Float32[np.ndarray, "H W"]:
        """Predict the depth of a photograph (sRGB), at its size.

        Raises:
            ParameterError: The photograph does not fit into memory.
            SceneFormatError: The network does not run on such an image.
        """
        height, width = image.shape[:2]
        processor = self._pipeline.image_processor
        if getattr(processor, "do_pad", False) and (
            divisor := getattr(processor, "size_divisor", 0)
        ):
            # transformers pads to a multiple, too, but leaves the padding in the map.
            margins = ((0, -height % divisor), (0, -width % divisor), (0, 0))
            image = np.pad(image, margins, mode="edge")
        try:
            with np.errstate(all="ignore"):  # its picture of a constant map
                depth = self._pipeline(PilImage.fromarray(image))["predicted_depth"]
        except (RuntimeError, ValueError) as error:
            raise _failure(error, f"{width} x {height}") from error
        return np.asarray(depth.float().cpu().numpy()[:height, :width])


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
    """Predict a depth map for each image of a scene; ``splatseed.io.find_depths`` reads them.

    Args:
        scene: A scene with photographs.
        network: From ``load_network``.
        output: Folder for the maps, a float32 ``.npy`` each.
        max_size: Larger photographs are downsampled to this longer side, in pixels; a map has the
            size that the network sees.
        overwrite: Replace maps that splatseed wrote before.
        provenance: Record of how the maps are made, for ``splatseed.json``.
        progress: Called with the stage and the fraction done.

    Raises:
        SceneNotFoundError: The scene has no images, or fewer than half of the photographs.
        SceneFormatError: A photograph cannot be decoded, or differs from its camera in aspect
            ratio.
        OutputError: The folder cannot be written.
    """
    scene, output, kind = with_photographs(scene), Path(output), network.meaning.kind
    inputs, flat = scene.source.inputs, list[str]()
    with depth_folder(
        output, kind, overwrite=overwrite, protect=inputs, provenance=provenance
    ) as writer:
        sizes = _check_photographs(scene, max_size, progress)
        start = time.perf_counter()
        progress("predict depth", 0.0)
        for done, (name, size) in enumerate(sizes.items(), 1):
            picture = PilImage.fromarray(scene[name].read())
            if picture.size != size:
                picture = picture.resize(size, PilImage.Resampling.BICUBIC)
            values = network(np.array(picture))
            finite = np.isfinite(values)
            writer.write(name, np.where(finite, values, np.float32(np.nan)))
            if not finite.any() or np.ptp(values[finite]) == 0:
                flat.append(name)
            progress("predict depth", done / len(sizes))
    return DepthReport(sizes, tuple(flat), time.perf_counter() - start)


def _check_photographs(
    scene: Scene, max_size: int, progress: Progress
) -> dict[str, tuple[int, int]]:
    names, sizes = sorted(image.name for image in scene.images), {}
    check_sizes(scene.images)
    for name in names:
        width, height = check_photograph(scene[name].path)
        factor = min(max_size / max(width, height), 1.0)
        sizes[name] = max(round(width * factor), 1), max(round(height * factor), 1)
        progress("check images", len(sizes) / len(names))
    return sizes


def load_network(
    model: str, *, depth_kind: DepthKind | None = None, device: DeviceName = "auto"
) -> DepthNetwork:
    """Load a depth network from this machine; transformers prints nothing from then on.

    Args:
        model: A folder with ``config.json``, ``preprocessor_config.json`` and weights, or the id of
            a model in Hugging Face's cache.
        depth_kind: What the network predicts; by default what its type and configuration imply.
        device: Where to run it; ``auto`` takes a GPU if PyTorch sees one.

    Raises:
        MissingDependencyError: The image processor needs torchvision, which is absent.
        SceneNotFoundError: The model is not on this machine; the message has the command for it.
        SceneFormatError: It is not a depth network, or is damaged.
        ParameterError: There is no such device, or nothing implies what the network predicts.
    """
    torch_device, path = pick_torch_device(device, "device"), Path(model)
    if path.is_file() or (path.is_dir() and not (path / "config.json").is_file()):
        raise _not_a_network(model, "a file" if path.is_file() else "no config.json in it")
    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)
    transformers.utils.logging.disable_progress_bar()
    config = _read_config(model)
    meaning = _meaning_of(config.to_dict(), model, depth_kind)
    if config.model_type == "zoedepth" and find_spec("torchvision") is None:
        raise _needs_torchvision(model)
    return DepthNetwork(*_load_weights(model), meaning, torch_device)


def _meaning_of(config: Mapping[str, Any], name: str, given: DepthKind | None) -> Meaning:
    """What a network predicts: as given, or by its ``config.json``."""
    model_type = config["model_type"]
    if given is not None:
        return Meaning(given, "as given")
    if model_type in METRIC:
        return Meaning("z", f"{METRIC[model_type]} predicts metres")
    if model_type == "depth_anything":
        if config.get("depth_estimation_type", "relative") == "metric":
            return Meaning("z", "its config has depth_estimation_type metric")
        return Meaning("inverse", "Depth Anything is relative unless its config says metric")
    if model_type == "dpt":  # published by MiDaS, and with DINOv2
        if (config.get("backbone_config") or {}).get("model_type") == "dinov2":
            return Meaning("z", "DPT on DINOv2 predicts metres")
        return Meaning("inverse", "DPT of MiDaS predicts inverse depth")
    raise errors.ParameterError(
        f"`depth_kind` for {name}",
        found=f"a network of type {model_type!r}, whose configuration does not imply it",
        fix="Pass `depth_kind='inverse'` for networks that predict disparity (MiDaS, Depth Anything"
        " without 'Metric'), `depth_kind='z'` for those that predict metres.",
    )


def _read_config(model: str) -> Any:
    try:
        config = transformers.AutoConfig.from_pretrained(model, **LOCAL)
    except Exception as error:  # transformers raises errors of many libraries
        if Path(model).is_dir():
            raise _not_a_network(model, _one_line(error)) from error
        is_id = re.fullmatch(r"\w[\w.-]*/\w[\w.-]*", model)
        raise errors.SceneNotFoundError(
            f"the depth network {model} on this machine",
            found="neither a folder of that name nor a copy in Hugging Face's cache",
            fix=f"splatseed downloads nothing by itself. {_fetch(model if is_id else EXAMPLE)}",
        ) from error
    if type(config) not in transformers.MODEL_FOR_DEPTH_ESTIMATION_MAPPING:
        raise _not_a_network(model, f"a network of type {config.model_type}, not for depth")
    return config


def _load_weights(model: str) -> tuple[Any, Any]:
    """Image processor and network, from local files only, with all weights."""
    try:
        # Pillow's resizing, with or without torchvision: the same maps on every machine.
        processor = transformers.AutoImageProcessor.from_pretrained(model, backend="pil", **LOCAL)
        network, loading = transformers.AutoModelForDepthEstimation.from_pretrained(
            model, dtype=torch.float32, output_loading_info=True, **LOCAL
        )
    except MemoryError:
        raise
    except Exception as error:  # transformers raises errors of many libraries
        if "torchvision" in str(error).lower() and find_spec("torchvision") is None:
            raise _needs_torchvision(model) from error
        raise _not_a_network(model, _one_line(error)) from error
    parameters = {name for name, _ in network.named_parameters()}
    missing = loading["missing_keys"] & parameters
    if missing := sorted(name for name in missing if not UNUSED_WEIGHTS.search(name)):
        raise _not_a_network(model, f"no weights for {missing[0]} and {len(missing) - 1} more")
    return processor, network.eval()


def _failure(error: Exception, size: str) -> errors.SplatseedError:
    # PyTorch's memory errors on the CPU contain "allocate".
    if isinstance(error, torch.cuda.OutOfMemoryError) or "allocate" in str(error):
        return errors.ParameterError(
            f"enough memory for an image of {size}",
            found=_one_line(error).partition(". ")[0],
            fix="Pass a smaller `max_size`.",
        )
    return errors.SceneFormatError(
        f"a network that takes images of {size} pixels",
        found=_one_line(error),
        fix="Its preprocessor_config.json may belong to another network.",
    )


def _needs_torchvision(model: str) -> errors.MissingDependencyError:
    pip = f"{quoted(sys.executable or 'python')} -m pip install torchvision"
    return errors.MissingDependencyError(
        f"torchvision, which the image processor of {model} needs",
        found="none",
        fix=f"Install it for your version of PyTorch: {pip}.",
    )


def _not_a_network(model: str, found: str) -> errors.SceneFormatError:
    return errors.SceneFormatError(
        f"{model} to be a depth network that transformers loads: a folder of config.json,"
        " preprocessor_config.json and weights",
        found=found,
        fix=f"Networks in other formats (.pth, .pt, .onnx) are not read. {_fetch(EXAMPLE)}",
    )


def _fetch(name: str) -> str:
    folder = name.rpartition("/")[2]
    return f"Run: hf download {name} --local-dir {folder} and pass `model='{folder}'`."


def _one_line(error: Exception) -> str:
    """First line of another library's error."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0].rstrip('.')}" if lines else type(error).__name__
