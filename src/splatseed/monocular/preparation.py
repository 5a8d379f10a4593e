"""How photographs become the input of an ONNX network, which its file does not say.

Notation: a photograph of H x W pixels becomes (pixel / 255 - mean) / std for each channel, at h x
w.
Promise: the user's choice takes precedence over files beside the network, and those over what most
depth networks use: 518 pixels in multiples of 14, and the colour statistics of ImageNet.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image as PilImage

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.files import read_text

Channels = tuple[float, float, float]


@dataclass(frozen=True)
class Preparation:
    """The user's choices about a network's input; None: not given.

    Args:
        input_size: Size in pixels to which the sides are scaled, if the network leaves them open.
        input_multiple: The sides are then rounded to a multiple of this.
        mean: Subtracted from the channels of an image in 0..1.
        std: Divides the channels after that.

    Raises:
        ParameterError: A number is out of its range.
    """

    input_size: int | None = None
    input_multiple: int | None = None
    mean: Channels | None = None
    std: Channels | None = None

    def __post_init__(self) -> None:
        for flag, value in (("size", self.input_size), ("multiple", self.input_multiple)):
            if value is not None and value < 1:
                raise ParameterError(
                    f"--input-{flag} of 1 or more", found=f"{value}", fix="Give it in pixels."
                )
        if not np.isfinite([*(self.mean or ()), *(self.std or ())]).all():
            raise ParameterError(
                "finite numbers for --mean and --std",
                found=f"{self.mean}, {self.std}",
                fix="Check.",
            )
        if self.std is not None and min(self.std) <= 0:
            raise ParameterError(
                "--std above 0", found=f"{self.std}", fix="Give one number per channel."
            )


@dataclass(frozen=True)
class InputForm:
    """How a network's input is made.

    Args:
        size: Size in pixels to which the sides are scaled.
        multiple: The sides are then rounded to a multiple of this.
        mean: Subtracted from the channels of an image in 0..1.
        std: Divides the channels after that.
    """

    size: int = 518
    multiple: int = 14
    mean: Channels = (0.485, 0.456, 0.406)
    std: Channels = (0.229, 0.224, 0.225)

    def sides(self, height: int, width: int) -> tuple[int, int]:
        """The input's height and width for photographs of a size.

        One factor scales both sides: of the two that bring a side to ``size``, the one nearer to 1.
        This is what DPT's own image processor does when it keeps the aspect ratio.
        """
        factor = min((self.size / height, self.size / width), key=lambda each: abs(1 - each))
        rows, columns = (round(side * factor / self.multiple) for side in (height, width))
        return max(rows, 1) * self.multiple, max(columns, 1) * self.multiple

    def values(
        self, image: UInt8[np.ndarray, "H W 3"], height: int, width: int
    ) -> Float32[np.ndarray, "3 h w"]:
        """A photograph as an input of that height and width."""
        picture = PilImage.fromarray(image).resize((width, height), PilImage.Resampling.BICUBIC)
        mean, std = np.array([self.mean, self.std], np.float32)
        scaled = (np.asarray(picture, np.float32) / 255 - mean) / std
        return np.asarray(scaled.transpose(2, 0, 1), np.float32)


def complete(said: Preparation, path: Path) -> InputForm:
    """The user's choices, completed from ``preprocessor_config.json`` beside a network's file.

    Raises:
        SceneFormatError: That file exists but does not belong to an image processor.
    """
    try:
        beside = _described(json_beside(path, "preprocessor_config.json"))
    except (KeyError, TypeError, ValueError, ParameterError) as error:
        raise SceneFormatError(
            f"preprocessor_config.json of {path} to be one of an image processor",
            found=f"{type(error).__name__}: {error}",
            fix="Remove it, and pass --input-size, --input-multiple, --mean and --std.",
        ) from error
    standard = InputForm()
    return InputForm(
        said.input_size or beside.input_size or standard.size,
        said.input_multiple or beside.input_multiple or standard.multiple,
        said.mean or beside.mean or standard.mean,
        said.std or beside.std or standard.std,
    )


def json_beside(path: Path, name: str) -> dict[str, Any]:
    """The JSON object of that name in a file's folder or the one above; empty if there is none.

    Raises:
        SceneFormatError: Such a file exists but holds something else.
    """
    for folder in (path.parent, path.resolve().parent.parent):
        try:
            content = json.loads(read_text(folder / name))
        except OSError:
            continue
        except (ValueError, RecursionError) as error:
            raise _no_object(folder / name, f"{type(error).__name__}: {error}") from error
        if not isinstance(content, dict):
            raise _no_object(folder / name, type(content).__name__)
        return content
    return {}


def _no_object(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to hold a JSON object", found=found, fix="Fetch it again, or remove it."
    )


def _described(config: Mapping[str, Any]) -> Preparation:
    size, multiple = config.get("size"), config.get("ensure_multiple_of")
    if isinstance(size, Mapping):
        size = min(size.values())
    mean, std = config.get("image_mean"), config.get("image_std")
    if config.get("do_normalize") is False:
        mean, std = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    return Preparation(
        None if size is None else int(size),
        None if multiple is None else int(multiple),
        None if mean is None else _three(mean),
        None if std is None else _three(std),
    )


def _three(values: Sequence[float]) -> Channels:
    red, green, blue = (float(each) for each in values)
    return red, green, blue
