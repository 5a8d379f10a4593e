"""The basis of spherical harmonics in NumPy: gsplat's, orthonormal, and that of the kernels."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatseed.rendering.autograd import Harmonics
from splatseed.rendering.harmonics import TERMS, sh_basis


@pytest.fixture
def directions(rng):
    vectors = rng.normal(size=(50, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


@pytest.mark.parametrize("terms", [1, 4, 9, 16])
def test_the_basis_is_gsplats(directions, terms):
    gsplat = pytest.importorskip("gsplat.cuda._torch_impl")
    expected = gsplat._eval_sh_bases_fast(terms, torch.from_numpy(directions)).numpy()
    np.testing.assert_allclose(sh_basis(directions, terms), expected, rtol=0, atol=1e-14)


def test_the_basis_is_orthonormal():
    # Gauss-Legendre in z, equidistant in the angle: exact for polynomials of degree 6.
    z, weights = np.polynomial.legendre.leggauss(8)
    z, angle = (grid.ravel() for grid in np.meshgrid(z, np.arange(16) * np.pi / 8, indexing="ij"))
    across = np.sqrt(1 - z * z)
    basis = sh_basis(np.stack([across * np.cos(angle), across * np.sin(angle), z], axis=1))
    gram = basis.T @ (basis * np.repeat(weights * np.pi / 8, 16)[:, None])
    np.testing.assert_allclose(gram, np.eye(TERMS), atol=1e-12)


def test_the_kernel_evaluates_the_same_basis(rng, directions):
    coefficients = 0.1 * rng.normal(size=(len(directions), TERMS, 3))
    shades = Harmonics.apply(
        torch.from_numpy(2.5 * directions).float(), torch.zeros(3),
        torch.from_numpy(coefficients).float(), None,
        torch.ones(len(directions), 2, dtype=torch.int32), 3,
    )  # fmt: skip
    expected = 0.5 + np.einsum("nk,nkc->nc", sh_basis(directions), coefficients)
    np.testing.assert_allclose(shades.numpy(), np.maximum(expected, 0), atol=1e-6)
