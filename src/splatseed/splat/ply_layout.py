"""3DGS's .ply layout: a vertex per Gaussian; f_rest_* are red, then green, then blue."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float32

XYZ, DC = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")

_RENDER_MODE = re.compile(
    rb"^comment[ \t]+(?:SplatRenderMode:|antialiased)[ \t]+(\w+)", re.MULTILINE | re.IGNORECASE
)


def rest_names(number: int) -> tuple[str, ...]:
    """Return the names of the coefficients of higher degrees."""
    return tuple(f"f_rest_{i}" for i in range(number))


def antialiased_comment(antialiased: bool) -> list[str]:
    """Return Brush's header line for antialiased rendering, or none."""
    return ["comment SplatRenderMode: mip"] if antialiased else []


def is_antialiased(header: bytes) -> bool:
    """Whether the header's last render mode, Brush's or Postshot's, is antialiased."""
    modes = _RENDER_MODE.findall(header)
    return bool(modes) and modes[-1].lower() in {b"mip", b"1"}


def encode_layout(
    arrays: Mapping[str, Float32[np.ndarray, "N ..."]], antialiased: bool
) -> list[bytes | memoryview]:
    """Encode ``Gaussians.arrays`` as a file's bytes."""
    count, rest = len(arrays["means"]), 3 * arrays["shN"].shape[1]
    harmonics = arrays["shN"].transpose(0, 2, 1).reshape(count, rest)
    columns = [
        (XYZ, arrays["means"]),
        (("nx", "ny", "nz"), np.zeros((count, 3), np.float32)),
        (DC, arrays["sh0"][:, 0]),
        (rest_names(rest), harmonics),
        (("opacity",), arrays["opacities"][:, None]),
        (SCALES, arrays["scales"]),
        (ROTATION, arrays["quats"]),
    ]
    lines = ["ply", "format binary_little_endian 1.0", *antialiased_comment(antialiased)]
    lines += [f"element vertex {count}"]
    lines += [f"property float {name}" for names, _ in columns for name in names]
    table = np.concatenate([values for _, values in columns], axis=1, dtype="<f4")
    return ["\n".join([*lines, "end_header\n"]).encode("ascii"), table.data]
