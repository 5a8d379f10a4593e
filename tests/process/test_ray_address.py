"""The address of a Ray cluster, before Ray is asked."""

from __future__ import annotations

import socket

import pytest

pytest.importorskip("ray", reason="Ray is an extra: pip install -e '.[cluster]'")

from splatseed.errors import ParameterError
from splatseed.process.ray_tasks import ray_cluster


@pytest.fixture
def silent(monkeypatch):
    """A port at which nothing listens; Ray may not be asked about it, as it does not give up."""
    monkeypatch.setattr("ray.init", lambda **_: pytest.fail("Ray was asked"))
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        yield reserved.getsockname()[1]


@pytest.mark.parametrize("address", ["127.0.0.1:{}", "ray://127.0.0.1:{}", "127.0.0.1:{}0000"])
def test_where_nothing_answers_is_no_cluster(silent, address):
    address = address.format(silent)
    with pytest.raises(ParameterError, match="no answer there") as caught, ray_cluster(address):
        pass
    assert f"a Ray cluster at {address}" in str(caught.value)


@pytest.mark.parametrize("address", ["nonsense", "host:port"])
def test_what_is_no_address_is_said_by_ray(address):
    with pytest.raises(ParameterError, match="a Ray cluster at"), ray_cluster(address):
        pass
