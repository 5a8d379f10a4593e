"""Depth networks in ``.onnx`` files, run by onnxruntime.

Notation: a network takes [B, 3, h, w] and returns [B, h', w'] or [B, 1, h', w']; B, h and w are
fixed by the file or left open. A photograph becomes (pixel / 255 - mean) / std for each channel.
Promise: PyTorch is not needed; the input's name, type and size are the file's; a file of another
form is refused before it is run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image as PilImage

from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.monocular.network import DeviceName, Meaning, meaning_of, one_line
from splatseed.monocular.preparation import InputForm, Preparation, complete, json_beside

_TYPES: dict[str, np.dtype[Any]] = {
    "tensor(float)": np.dtype(np.float32),
    "tensor(float16)": np.dtype(np.float16),
}
_OUTPUTS = ("predicted_depth", "depth")
"""Names of the output that is taken if a network has several."""
_ERRORS_ONLY = 3
"""onnxruntime's level of logging."""


@dataclass(frozen=True)
class _Fixed:
    """What a file fixes: its input's name and type, and B, h, w; None where left open."""

    name: str
    dtype: np.dtype[Any]
    batch: int | None
    height: int | None
    width: int | None
    output: str


class OnnxNetwork:
    """A network that onnxruntime has loaded.

    Args:
        path: The file, for errors.
        session: onnxruntime's session.
        meaning: What it predicts.
        form: How its input is made.
    """

    def __init__(self, path: Path, session: Any, meaning: Meaning, form: InputForm) -> None:
        self.meaning = meaning
        self._path = path
        self._session = session
        self._form = form
        self._fixed = _read_fixed(path, session)

    @property
    def device(self) -> str:
        """Where it runs, in words."""
        return f"onnxruntime, {self._session.get_providers()[0].removesuffix('ExecutionProvider')}"

    def __call__(
        self, images: Sequence[UInt8[np.ndarray, "H W 3"]]
    ) -> list[Float32[np.ndarray, "H W"]]:
        """Predict for photographs of one size (sRGB), at their size.

        Raises:
            ParameterError: The network does not run on such an input.
            SceneFormatError: Its output is not one map per image.
        """
        height, width = images[0].shape[:2]
        free = self._form.sides(height, width)
        sides = self._fixed.height or free[0], self._fixed.width or free[1]
        values = np.stack([self._form.values(image, *sides) for image in images])
        step = self._fixed.batch or len(images)
        parts = [self._run(values[i : i + step]) for i in range(0, len(images), step)]
        return [_scaled(each, (width, height)) for part in parts for each in part]

    def _run(self, values: Float32[np.ndarray, "b 3 h w"]) -> Float32[np.ndarray, "b h2 w2"]:
        """The network's own maps; a fixed batch is filled up with the last image."""
        count = len(values)
        short = (self._fixed.batch or count) - count
        full = np.concatenate([values, np.repeat(values[-1:], short, axis=0)])
        feed = {self._fixed.name: full.astype(self._fixed.dtype)}
        try:
            (output,) = self._session.run([self._fixed.output], feed)
        except Exception as error:  # onnxruntime's own errors have no common base
            raise ParameterError(
                f"{self._path} to take an input of {list(full.shape)}",
                found=one_line(error),
                fix="Pass the --input-size and --input-multiple that the network was made for.",
            ) from error
        maps = np.asarray(output, np.float32)
        maps = maps[:, 0] if maps.ndim == 4 and maps.shape[1] == 1 else maps
        if maps.ndim != 3 or len(maps) != len(full) or not maps.size:
            raise _misfit(self._path, f"an output of {list(np.shape(output))}")
        return maps[:count]


def load_onnx(
    path: Path,
    *,
    kind: DepthKind | None = None,
    device: DeviceName = "auto",
    preparation: Preparation | None = None,
) -> OnnxNetwork:
    """Load an ``.onnx`` file.

    ``config.json`` and ``preprocessor_config.json`` beside it, or one folder up as in Hugging
    Face's collections of such files, say what it predicts and how its input is made.

    Args:
        path: The file.
        kind: What it predicts; None: what ``config.json`` says.
        device: Where to run it; auto takes a GPU if onnxruntime can use one.
        preparation: How its input is made; fields that are None are looked up.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not a depth network, or is damaged.
        ParameterError: There is no such device, or nothing says what it predicts.
    """
    if not path.is_file():
        raise SceneNotFoundError(
            f"an ONNX file at {path}",
            found="a folder" if path.is_dir() else "none",
            fix="Check the path. Fetch one, such as:"
            " hf download onnx-community/depth-anything-v2-small --local-dir depth-anything-onnx.",
        )
    meaning = meaning_of(json_beside(path, "config.json"), path.name, kind)
    form = complete(preparation or Preparation(), path)
    return OnnxNetwork(path, _session(path, device), meaning, form)


def _session(path: Path, device: DeviceName) -> Any:
    import onnxruntime  # noqa: PLC0415  (slow to import)

    has_gpu = "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    if device == "cuda" and not has_gpu:
        raise ParameterError(
            "a GPU for --device cuda",
            found="none that onnxruntime can use",
            fix="Pass --device cpu, or install onnxruntime-gpu in place of onnxruntime.",
        )
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ERRORS_ONLY
    providers = ["CUDAExecutionProvider"] * (has_gpu and device != "cpu")
    try:
        return onnxruntime.InferenceSession(
            str(path), options, providers=[*providers, "CPUExecutionProvider"]
        )
    except MemoryError:
        raise
    except Exception as error:  # onnxruntime's own errors have no common base
        raise _misfit(path, one_line(error)) from error


def _read_fixed(path: Path, session: Any) -> _Fixed:
    inputs, outputs = session.get_inputs(), session.get_outputs()
    if len(inputs) != 1 or inputs[0].type not in _TYPES or len(inputs[0].shape) != 4:
        raise _misfit(path, "inputs " + ", ".join(f"{i.type} {i.shape}" for i in inputs))
    batch, channels, height, width = (n if isinstance(n, int) else None for n in inputs[0].shape)
    if channels not in {3, None}:
        raise _misfit(path, f"an input of {inputs[0].shape}")
    fitting = [each.name for each in outputs if len(each.shape or (0, 0, 0)) in {3, 4}]
    named = [name for name in _OUTPUTS if name in fitting] or fitting
    if not named:
        raise _misfit(path, "outputs " + ", ".join(f"{o.name} {o.shape}" for o in outputs))
    return _Fixed(inputs[0].name, _TYPES[inputs[0].type], batch, height, width, named[0])


def _scaled(depth: Float32[np.ndarray, "h w"], size: tuple[int, int]) -> Float32[np.ndarray, "H W"]:
    """Resized to the photograph's width and height, bilinearly, pixel centres at +0.5."""
    picture = PilImage.fromarray(np.ascontiguousarray(depth))
    return np.asarray(picture.resize(size, PilImage.Resampling.BILINEAR))


def _misfit(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to be a depth network in ONNX: one float input [B, 3, H, W], an output [B, H, W]"
        " or [B, 1, H, W]",
        found=found,
        fix="Export it again, or give a folder of transformers' format.",
    )
