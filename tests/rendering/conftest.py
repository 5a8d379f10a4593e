"""Rendering needs PyTorch; without it, these tests are skipped."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="rendering needs splatseed[train]")
pytest.importorskip("gsplat", reason="rendering is compared with gsplat's published code")


@pytest.fixture(autouse=True, scope="session")
def one_thread_for_the_reference():
    """The reference's tensors are tiny: more threads only add overhead."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
