"""A ray-cast room whose depth is known."""

from __future__ import annotations

import pytest

from splatseed.synthetic import make_capture
from splatseed.train.views import View


@pytest.fixture(scope="session")
def exact_room():
    """The demo's room, small: 12 views of 160 x 120."""
    return make_capture(0, num_views=12, width=160, height=120)


@pytest.fixture(scope="session")
def room_views(exact_room):
    """Its photographs as views."""
    cameras = (image.camera for image in exact_room.scene.images)
    return [
        View(f"{k}", pixels, c.K, c.width, c.height, c.cam_from_world)
        for k, (pixels, c) in enumerate(zip(exact_room.images, cameras, strict=True))
    ]
