"""Gaussians: the parameters of a 3DGS model, and the layout of its .ply files.

Names and conventions are gsplat's: ``scales`` are logarithms, ``opacities`` logits, ``quats`` wxyz
of any length. In a .ply a vertex is a Gaussian; f_rest_* are red, then green, then blue. PyTorch is
not needed.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int64

from splatseed.findings import Finding
from splatseed.frozen import read_only
from splatseed.io.files import StrPath
from splatseed.io.staging import atomic_file

PARAMETERS = ("means", "scales", "quats", "opacities", "sh0", "shN")
"""Names of the parameter arrays, in order."""
SH_C0 = 0.28209479177387814
"""Spherical harmonic of degree 0, 1 / (2 sqrt(pi)); colour = 0.5 + SH_C0 * sh0."""
SH_C1 = 0.4886025119029199  # of degree 1, sqrt(3 / (4 pi))
SH_COUNTS = (0, 3, 8, 15)
"""Coefficients beyond the first, by the degree of the spherical harmonics."""
VISIBLE_LOGIT = -2.2  # opacity of about a tenth; fainter Gaussians do not show where a scene is
XYZ, DC = ("x", "y", "z"), ("f_dc_0", "f_dc_1", "f_dc_2")
SCALES = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")

_RENDER_MODE = re.compile(
    rb"^comment[ \t]+(?:SplatRenderMode:|antialiased)[ \t]+(\w+)", re.MULTILINE | re.IGNORECASE
)


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians with the parameters of 3DGS's .ply and gsplat; float32, read-only arrays.

    ``ss.read_gaussians`` reads them and ``ss.render`` renders them. Spherical harmonics have degree
    0 to 3: K = 0, 3, 8 or 15.
    """

    means: Float32[np.ndarray, "N 3"]  # positions
    scales: Float32[np.ndarray, "N 3"]  # logarithms of standard deviations
    quats: Float32[np.ndarray, "N 4"]  # wxyz, of any length but 0
    opacities: Float32[np.ndarray, " N"]  # logits: 1 / (1 + exp(-x)) is the opacity
    sh0: Float32[np.ndarray, "N 1 3"]  # of harmonics: 0.5 + 0.2821 sh0 is the mean sRGB colour
    shN: Float32[np.ndarray, "N K 3"]  # noqa: N815  (gsplat's name)  # of higher degrees
    antialiased: bool = False  # needs ``rasterize_mode="antialiased"``

    def __post_init__(self) -> None:
        for name in PARAMETERS:
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        blur = ", antialiased" if self.antialiased else ""
        return f"Gaussians({len(self):,}, SH degree {self.sh_degree}{blur})"

    @property
    def sh_degree(self) -> int:
        """The degree of the spherical harmonics."""
        return math.isqrt(1 + self.shN.shape[1]) - 1

    @property
    def num_bytes(self) -> int:
        """Bytes of the parameters as float32: 236 per Gaussian at degree 3."""
        return sum(array.nbytes for array in self.arrays().values())

    def arrays(self) -> dict[str, Float32[np.ndarray, "N ..."]]:
        """Return the parameters by name, in the order of ``PARAMETERS``."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def select(self, index: Bool[np.ndarray, " N"] | Int64[np.ndarray, " M"]) -> Gaussians:
        """Return some of the Gaussians, by index or mask."""
        parts = {name: array[index] for name, array in self.arrays().items()}
        return dataclasses.replace(self, **parts)

    def write_ply(self, path: StrPath) -> None:
        """Write 3DGS's .ply, which every viewer and trainer reads; replaces an existing file.

        Raises:
            OutputError: The file cannot be written.
        """
        with atomic_file(Path(path)) as partial, partial.open("wb") as file:
            file.writelines(encode_layout(self.arrays(), self.antialiased))


def antialiasing_finding(file: str) -> Finding:
    """Return the finding on an antialiased model in a file that cannot record it."""
    return Finding(
        "antialiasing-lost",
        f"The model needs antialiased rendering, which {file} cannot record: small Gaussians will "
        "be too opaque.",
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
