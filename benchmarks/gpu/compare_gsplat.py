"""gsplat on CUDA and our CPU rasteriser on the same inputs: image, alpha and every gradient.

They agree where at most ``ODD_ONES`` of the entries differ by more than ``TOLERANCE`` of the
largest. gsplat works in float32 with a fast exponential and adds gradients in any order; now and
then a pixel falls on the other side of the cut-off at 1/255, hence the allowance. What ``grow``
measures, each Gaussian's pixels and errors, is compared as well.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from splatseed.camera import Camera
from splatseed.photos.view import view_of
from splatseed.rendering import rasterization
from splatseed.training.device import pick_device
from splatseed.training.strategies.grow import contributions

__all__ = ["ODD_ONES", "TOLERANCE", "compare"]

TOLERANCE = 1e-3
ODD_ONES = 1e-4
CROWD_SIZE = (400, 300)
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")

Arrays = dict[str, np.ndarray]


class Case(NamedTuple):
    """Inputs as arrays, and the arguments that are not."""

    inputs: Arrays
    options: dict[str, Any]


def compare(crowd: int) -> list[dict[str, Any]]:
    """All cases: ``case``, ``worst`` array with its differences, and ``problem``, empty if none.

    Args:
        crowd: How many Gaussians the larger cases have.
    """
    pick_device("cuda")  # so that gsplat, which compiles at its first call, finds ninja
    found = []
    for name, case in cases(crowd).items():
        try:
            theirs = run(_gsplat(), case, "cuda")
            found.append(difference(name, run(rasterization, case, "cpu"), theirs))
        except Exception as error:  # noqa: BLE001  (reported; the other cases go on)
            found.append(_failed(name, error))
    try:
        case = _case(8, n=crowd, size=CROWD_SIZE)
        found.append(difference("contributions", _shares(case, "cpu"), _shares(case, "cuda")))
    except Exception as error:  # noqa: BLE001  (likewise)
        found.append(_failed("contributions", error))
    return found


def _failed(name: str, error: Exception) -> dict[str, Any]:
    told = f"{name}: {type(error).__name__}: {error}"
    return {"case": name, "worst": ["failed", "", ""], "problem": told}


def _gsplat() -> Callable[..., Any]:
    from gsplat import rasterization as theirs  # noqa: PLC0415  (once ninja is found)

    return theirs  # type: ignore[no-any-return]  # gsplat is untyped


def cases(crowd_of: int) -> dict[str, Case]:
    """Small ones, and crowds as training sees them."""
    small = {"n": 32, "size": (21, 13)}
    crowd = {"n": crowd_of, "size": CROWD_SIZE}
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
    if options.get("packed", True):
        del arrays["backgrounds"]  # gsplat 1.5.3 refuses them with packed: it asserts another shape
    inputs = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Case(inputs, {"width": width, "height": height, **options})


def _viewmat(rng: np.random.Generator, distance: float) -> np.ndarray:
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation * np.sign(np.linalg.det(rotation))
    viewmat[2, 3] = distance
    return viewmat


def run(rasterize: Callable[..., Any], case: Case, device: str) -> Arrays:
    """Images, alphas and gradients of one case, as arrays."""
    tensors = {name: torch.from_numpy(array).to(device) for name, array in case.inputs.items()}
    leaves = {name: tensors[name].requires_grad_() for name in INPUTS if name in tensors}
    image, alpha, info = rasterize(**tensors, **case.options)
    info["means2d"].retain_grad()
    ((image - 0.3).square().sum() + (alpha - 0.5).square().sum()).backward()
    results = {"image": image, "alpha": alpha}
    results |= {f"d_{name}": leaf.grad for name, leaf in leaves.items()}
    if not case.options.get("packed", True):
        results["d_means2d"] = info["means2d"].grad
    if case.options.get("absgrad"):
        results["absgrad"] = info["means2d"].absgrad
    return {name: each.detach().cpu().numpy() for name, each in results.items()}


def _shares(case: Case, device: str) -> Arrays:
    """Each Gaussian's pixels and errors in the case's first view; the error is a ramp over it."""
    inputs = {name: torch.from_numpy(array).to(device) for name, array in case.inputs.items()}
    params = {
        "means": inputs["means"],
        "quats": inputs["quats"],
        "scales": inputs["scales"].log(),
        "opacities": inputs["opacities"].logit(1e-4),
    }
    width, height = case.options["width"], case.options["height"]
    pose, K = (case.inputs[name][0].astype(np.float64) for name in ("viewmats", "Ks"))
    view = view_of(Camera(K, width, height, pose))
    ramp = torch.linspace(0, 1, width, device=device).expand(height, -1).contiguous()
    pixels, errors = contributions(params, view, ramp)
    return {"pixels": pixels.cpu().numpy(), "errors": errors.cpu().numpy()}


def difference(name: str, ours: Arrays, theirs: Arrays) -> dict[str, Any]:
    """The array that differs most, and which have too many entries that do."""
    odd, largest = {}, {}
    for key, expected in theirs.items():
        relative = np.abs(ours[key] - expected) / max(float(np.abs(expected).max()), 1e-12)
        odd[key], largest[key] = float((~(relative <= TOLERANCE)).mean()), float(relative.max())
    worst = max(theirs, key=lambda key: (odd[key], largest[key]))
    wrong = ", ".join(f"{key} ({odd[key]:.1e})" for key in theirs if odd[key] > ODD_ONES)
    return {
        "case": name,
        "worst": [worst, f"{largest[worst]:.1e}", f"{odd[worst]:.1e}"],
        "problem": f"{name}: too many entries differ in {wrong}" if wrong else "",
    }
