"""gsplat on CUDA and our CPU rasteriser on the same inputs: image, alpha and every gradient.

Run on a machine with CUDA and gsplat 1.5.3::

    python benchmarks/gpu/compare_gsplat.py --golden tests/render/golden_gsplat.npz

Prints, by case and array, the largest difference over the largest entry, and exits with 1 where
more than ``ODD_ONES`` of the entries differ by more than ``TOLERANCE``. gsplat works in float32
with a fast exponential and adds gradients in any order; now and then a pixel falls on the other
side of the cut-off at 1/255, hence the allowance. ``--golden`` keeps the small cases, inputs and
gsplat's results, for the tests of machines without a GPU.

The golden file (.npz) holds float32 arrays ``case/inputs/NAME`` and ``case/outputs/NAME`` and, as
``case/options``, the other arguments in JSON. Outputs are ``image``, ``alpha`` and ``d_NAME``, the
gradient of sum (image - 0.3)^2 + sum (alpha - 0.5)^2; ``d_means2d`` and ``absgrad`` where not
packed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from splatseed.render import rasterization

TOLERANCE = 1e-3
ODD_ONES = 1e-4
MAX_GOLDEN_BYTES = 100_000
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")

Arrays = dict[str, np.ndarray]


class Case(NamedTuple):
    """Inputs as arrays, and the arguments that are not."""

    inputs: Arrays
    options: dict[str, Any]
    golden: bool


def main() -> int:
    """Compare all cases; 0 if they agree, 1 if not, 2 without a GPU."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--golden", type=Path, help="write the small cases to this .npz")
    arguments = parser.parse_args()
    if not torch.cuda.is_available():
        print("expected a CUDA device; found none. Run this on a machine with a GPU.")
        return 2
    agrees, kept = True, {}
    for name, case in cases().items():
        theirs = run(_gsplat(), case, "cuda")
        ours = run(rasterization, case, "cpu")
        agrees &= report(name, ours, theirs)
        if case.golden:
            kept.update(_flat(name, case, theirs))
    if arguments.golden:
        _write(arguments.golden, kept)
    return 0 if agrees else 1


def _gsplat() -> Callable[..., Any]:
    from gsplat import rasterization as theirs  # noqa: PLC0415  (compiles for CUDA when imported)

    return theirs  # type: ignore[no-any-return]  # gsplat is untyped


def cases() -> dict[str, Case]:
    """Small ones to keep, and crowds as training sees them."""
    small = {"n": 32, "size": (21, 13)}
    crowd = {"n": 30_000, "size": (400, 300)}
    antialiased = {"rasterize_mode": "antialiased", "render_mode": "RGB+ED"}
    return {
        "degree 3": _case(0, **small, coefficients=16, sh_degree=3),
        "not packed, absgrad": _case(1, **small, packed=False, absgrad=True),
        "antialiased, depth": _case(2, **small, **antialiased),
        "opaque": _case(3, **small, opaque=True),
        "crowd, degree 3": _case(4, **crowd, coefficients=16, sh_degree=3),
        "crowd, absgrad": _case(5, **crowd, packed=False, absgrad=True),
        "crowd, antialiased, depth": _case(6, **crowd, **antialiased),
        "crowd, nine channels": _case(7, **crowd, channels=9),
    }


def _case(
    seed: int,
    *,
    n: int,
    size: tuple[int, int],
    channels: int = 3,
    coefficients: int = 0,
    opaque: bool = False,
    **options: Any,
) -> Case:
    """Gaussians of all shapes before two cameras; a few behind them and out of the image."""
    rng = np.random.default_rng(seed)
    width, height = size
    largest = -0.5 - np.log(n / 40) / 3
    opacities = rng.uniform(0.98, 1.0, n) if opaque else rng.uniform(0.0, 1.0, n)
    arrays = {
        "means": rng.uniform(-1.5, 1.5, (n, 3)),
        "quats": rng.normal(size=(n, 4)),
        "scales": np.exp(rng.uniform(largest - 3, largest, (n, 3))),
        "opacities": opacities,
        "colors": rng.normal(size=(n, coefficients, 3)) if coefficients
        else rng.random((n, channels)),
        "viewmats": np.stack([_viewmat(rng, distance) for distance in (3.0, 1.0)]),
        "Ks": np.tile([[width, 0, width / 2], [0, width, 0.45 * height], [0, 0, 1]], (2, 1, 1)),
        "backgrounds": rng.random((2, 3 if coefficients else channels)),
    }  # fmt: skip
    inputs = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Case(inputs, {"width": width, "height": height, **options}, golden=n < 100)


def _viewmat(rng: np.random.Generator, distance: float) -> np.ndarray:
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    viewmat[2, 3] = distance
    return viewmat


def run(rasterize: Callable[..., Any], case: Case, device: str) -> Arrays:
    """Images, alphas and gradients of one case, as arrays."""
    tensors = {name: torch.from_numpy(array).to(device) for name, array in case.inputs.items()}
    for name in INPUTS:
        tensors[name].requires_grad_()
    image, alpha, info = rasterize(**tensors, **case.options)
    info["means2d"].retain_grad()
    ((image - 0.3).square().sum() + (alpha - 0.5).square().sum()).backward()
    results = {"image": image, "alpha": alpha}
    results |= {f"d_{name}": tensors[name].grad for name in INPUTS}
    if not case.options.get("packed", True):
        results["d_means2d"] = info["means2d"].grad
    if case.options.get("absgrad"):
        results["absgrad"] = info["means2d"].absgrad
    return {name: each.detach().cpu().numpy() for name, each in results.items()}


def report(name: str, ours: Arrays, theirs: Arrays) -> bool:
    """Print one line an array; whether all of them agree."""
    agree = True
    print(f"{name}\n  {'array':<16}{'largest':>10}{'beyond':>10}   (tolerance {TOLERANCE})")
    for key, expected in theirs.items():
        relative = np.abs(ours[key] - expected) / max(float(np.abs(expected).max()), 1e-12)
        odd = float((~(relative <= TOLERANCE)).mean())
        agree &= odd <= ODD_ONES
        print(f"  {key:<16}{relative.max():>10.1e}{odd:>10.1e}{'' if odd <= ODD_ONES else '  !'}")
    return agree


def _flat(name: str, case: Case, outputs: Arrays) -> dict[str, Any]:
    """A case under the names it has in the golden file."""
    return {
        f"{name}/options": json.dumps(case.options),
        **{f"{name}/inputs/{key}": array for key, array in case.inputs.items()},
        **{f"{name}/outputs/{key}": array for key, array in outputs.items()},
    }


def _write(path: Path, arrays: dict[str, Any]) -> None:
    np.savez_compressed(path, **arrays)
    size = path.stat().st_size
    print(f"wrote {path}, {size} bytes")
    if size > MAX_GOLDEN_BYTES:
        print(f"WARNING: more than {MAX_GOLDEN_BYTES} bytes is too much to keep with the tests")


if __name__ == "__main__":
    sys.exit(main())
