"""OpenSfM and ODM: projections by OpenSfM's page of geometric models, and what is left out."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.errors import SceneFormatError, SceneNotFoundError

from .exports import SIZE, check_projections, kinds, load, made_cameras, write_photographs

NAMES = [f"DJI_000{i}.png" for i in range(4)]
BROWN = {"projection_type": "brown", "focal_x": 0.85, "focal_y": 0.86, "c_x": 0.01, "c_y": -0.02,
         "k1": -0.1, "k2": 0.05, "p1": 0.002, "p2": -0.003, "k3": -0.01}  # fmt: skip
PERSPECTIVE = {"projection_type": "perspective", "focal": 0.9, "k1": -0.06, "k2": 0.02}
FISHEYE = {"projection_type": "fisheye", "focal": 0.6, "k1": 0.03, "k2": -0.01}
OPENCV = {"projection_type": "fisheye_opencv", "focal_x": 0.6, "focal_y": 0.61, "c_x": 0.02,
          "k1": 0.03, "k2": -0.01, "k3": 0.005, "k4": -0.002}  # fmt: skip
LENSES = (BROWN, PERSPECTIVE, FISHEYE, OPENCV)


def geometric_models(rays, c, size=SIZE):
    """Normalised image coordinates, then H of "Pixel Coordinates" + 0.5 for the image corner."""
    x, y, z = rays.T
    k = [c.get(f"k{i}", 0) for i in range(1, 5)]
    fx, fy = c.get("focal_x", c.get("focal")), c.get("focal_y", c.get("focal"))
    if "fisheye" in c["projection_type"]:
        r = np.sqrt(x**2 + y**2)
        theta = np.arctan2(r, z)
        d = theta * sum(
            ([1, *k][i] * theta ** (2 * i) for i in range(5)), start=np.zeros_like(theta)
        )
        xd, yd = d * x / r, d * y / r
    else:
        x, y = x / z, y / z
        r2 = x**2 + y**2
        radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
        p1, p2 = c.get("p1", 0), c.get("p2", 0)
        xd = radial * x + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
        yd = radial * y + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)
    u, v = fx * xd + c.get("c_x", 0), fy * yd + c.get("c_y", 0)
    w, h = size
    return np.stack([max(w, h) * u + (w - 1) / 2, max(w, h) * v + (h - 1) / 2], axis=1) + 0.5


def write(path, made, lenses=LENSES, size=SIZE, count=4, **more):
    cameras = {
        f"v2 unknown {i}": {**lens, "width": size[0], "height": size[1]}
        for i, lens in enumerate(lenses)
    }
    shots = {
        NAMES[i]: {
            "rotation": Rotation.from_matrix(made.rotations[i]).as_rotvec().tolist(),
            "translation": made.translations[i].tolist(),
            "camera": f"v2 unknown {i % len(lenses)}",
            "gps_position": [1.0, 2.0, 3.0],
        }
        for i in range(count)
    }
    points = {
        str(i): {"coordinates": xyz.tolist(), "color": rgb.astype(float).tolist()}
        for i, (xyz, rgb) in enumerate(zip(made.xyz, made.rgb, strict=True))
    }
    other = {"cameras": {}, "shots": {}, "points": {}}
    content = {"cameras": cameras, "shots": shots, "points": points, **more}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps([other, content] if more else [content]))


@pytest.mark.parametrize("place", ["reconstruction.json", "opensfm/reconstruction.json"])
def test_projections_are_those_of_the_geometric_models(tmp_path, place):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "images", NAMES)
    write(root / place, made)
    for path in dict.fromkeys((root, root / place, (root / place).parent)):
        read = load(path)
        assert (read.source.format, kinds(read)) == ("opensfm", {"lens-distortion"})
        assert (read.source.root, read.source.image_dir) == (root, root / "images")
        assert [image.intrinsics.model for image in read.images] == [
            "FULL_OPENCV", "OPENCV", "OPENCV_FISHEYE", "OPENCV_FISHEYE"
        ]  # fmt: skip
        expected = [geometric_models(made.rays(i), LENSES[i]) for i in range(4)]
        check_projections(read, made, expected, NAMES)
        np.testing.assert_array_equal(read.points.xyz, made.xyz.astype(np.float32))
        np.testing.assert_array_equal(read.points.rgb, made.rgb)


def test_upright_photographs_and_masks(tmp_path):
    made, size = made_cameras(), SIZE[::-1]
    root = tmp_path / "scene"
    write_photographs(root / "images", [*NAMES, "other.png"], size)
    write_photographs(root / "masks", [f"{name}.png" for name in NAMES], size)
    write(root / "reconstruction.json", made, [PERSPECTIVE], size)
    read = load(root)
    expected = [geometric_models(made.rays(i), PERSPECTIVE, size) for i in range(4)]
    check_projections(read, made, expected, NAMES)
    assert read.masks.files.keys() == {*NAMES}
    (found,) = [each for each in read.findings if each.kind == "missing-poses"]
    assert found.subjects == ("other.png",)


def test_the_largest_reconstruction_is_read(tmp_path):
    made = made_cameras()
    write_photographs(tmp_path / "images", NAMES)
    write(tmp_path / "reconstruction.json", made, biases={})
    read = load(tmp_path)
    assert len(read.images) == 4
    assert "several-models" in kinds(read)


def test_damaged_files_are_one_error(tmp_path):
    made = made_cameras()
    write_photographs(tmp_path / "images", NAMES)
    path = tmp_path / "reconstruction.json"
    write(path, made, [{**BROWN, "projection_type": "dual"}])
    with pytest.raises(SceneFormatError, match=r"projection_type in .*'dual'.*Undistort"):
        load(tmp_path)
    write(path, made, [{"projection_type": "perspective"}])
    with pytest.raises(SceneFormatError, match="focal or focal_x"):
        load(tmp_path)
    write(path, made, count=0)
    with pytest.raises(SceneNotFoundError, match="photographs with poses"):
        load(tmp_path)
    for text in ("[]", "{}", '[{"shots": {"a.png": {}}}]', '[{"shots": 3}]', "[", "[3]"):
        path.write_text(text)
        with pytest.raises(SceneFormatError, match=r"reconstruction\.json"):
            load(tmp_path)
