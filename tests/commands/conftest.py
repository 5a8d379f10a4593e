"""Small captures on disk, as the commands are given them."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.io import load_scene, write_scene
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene


@pytest.fixture(autouse=True)
def _compare_once(compare_once):
    """Photographs are not the subject of commands."""


@pytest.fixture(scope="session")
def room(larger_room_path) -> Path:
    """The path of the larger room, which the commands are given."""
    return larger_room_path


@pytest.fixture
def own_room(room, tmp_path) -> Path:
    """A copy of the room that a test may spoil."""
    return Path(shutil.copytree(room, tmp_path / "own"))


@pytest.fixture
def rgbd(room, tmp_path) -> Path:
    """The room in Replica's layout."""
    folder = tmp_path / "rgbd"
    (folder / "results").mkdir(parents=True)
    images = sorted(load_scene(room).images, key=lambda image: image.name)
    for number, image in enumerate(images):
        for kind, place in (("frame", "images"), ("depth", "depths")):
            shutil.copy(room / place / image.name, folder / f"results/{kind}{number:06d}.png")
    poses = [np.linalg.inv(image.camera.cam_from_world).ravel() for image in images]
    np.savetxt(folder / "traj.txt", poses)
    camera, K = images[0].camera, images[0].camera.K
    sizes = {"w": camera.width, "h": camera.height, "scale": 5000}
    focal = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    (folder / "cam_params.json").write_text(json.dumps({"camera": {**sizes, **focal}}))
    return folder


@pytest.fixture(scope="session")
def as_by_a_device() -> Callable[..., Scene]:
    """Takes a scene's points away, and turns each of its cameras by half a degree or so."""

    def turned(scene: Scene, degrees: float = 0.5) -> Scene:
        rng = np.random.default_rng(0)
        images = tuple(
            dataclasses.replace(
                image,
                quat=quat_from_rotation(
                    Rotation.from_rotvec(np.radians(rng.normal(0, degrees, 3))).as_matrix()
                    @ image.camera.cam_from_world[:3, :3]
                ),
            )
            for image in scene.images
        )
        return scene.replace(images=images, points=PointCloud.empty(), tracks=None, depths=None)

    return turned


@pytest.fixture(scope="session")
def sharp_room(room_of) -> Scene:
    """The room in pictures large enough for features: 10 views of 256 x 192."""
    room = load_scene(room_of(12, 256, 192).path)  # which the tests of sfm have as well
    return room.replace(images=room.images[:10])


@pytest.fixture(scope="session")
def sharp_bare(sharp_room, as_by_a_device, tmp_path_factory) -> Path:
    """The same as a device gives it: poses that are off, and no points."""
    folder = tmp_path_factory.mktemp("sharp") / "bare"
    write_scene(as_by_a_device(sharp_room), folder, require_points=False)
    return folder
