"""Tiny networks, saved once."""

from __future__ import annotations

import numpy as np
import pytest

from ..networks import save_network


@pytest.fixture(scope="session")
def saved(tmp_path_factory):
    """The folder of a network by its name. Not to be written to."""
    pytest.importorskip("torch", reason="networks of transformers need PyTorch")
    pytest.importorskip("transformers", reason="needs splatseed[depth]")
    folder, made = tmp_path_factory.mktemp("networks"), {}

    def path(name):
        if name not in made:
            made[name] = save_network(name, folder / name)
        return made[name]

    return path


@pytest.fixture
def photographs(rng):
    """Three of noise, 90 x 60."""
    return [rng.integers(0, 256, (60, 90, 3), dtype=np.uint8) for _ in range(3)]


@pytest.fixture
def ramp():
    """A photograph, 118 x 77, whose red is u + 2 v with (u, v) the pixel's centre, from 0 at the corner."""
    v, u = np.mgrid[:77, :118] + 0.5
    return np.repeat((u + v)[..., None], 3, axis=2).astype(np.uint8)


@pytest.fixture
def offline(monkeypatch):
    """No connection may as much as be tried."""
    import socket

    def refuse(*_, **__):
        raise AssertionError("a connection was tried")

    for name in ("connect", "connect_ex"):
        monkeypatch.setattr(socket.socket, name, refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
