"""Meshroom: projections by AliceVision's formulas, in each version, and what is left out."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed.errors import SceneFormatError, SceneNotFoundError

from .exports import SIZE, check_projections, kinds, load, made_cameras, write_photographs

NAMES = [f"IMG_103{i}.png" for i in range(4)]
FX, FY, CENTER, SENSOR = 80.0, 120.0, (47.0, 37.5), 36.0
DISTORTIONS = {
    "radialk1": [-0.1],
    "radialk3": [-0.1, 0.04, -0.01],
    "brown": [-0.1, 0.04, -0.01, 0.003, -0.002],
    "fisheye": [0.02, -0.01, 0.004, -0.001],
    "fisheye1": [0.9],
    "none": [],
}
OLD = {"radialk1": "radial1", "radialk3": "radial3", "fisheye": "fisheye4", "none": "pinhole"}


def alicevision(rays, kind, k):
    """Distortion*::addDistortion, then cam2ima."""
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    r2 = x * x + y * y
    r = np.sqrt(r2)
    if kind.startswith("radial"):
        k1, k2, k3 = [*k, 0, 0][:3]
        scale = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = x * scale, y * scale
    elif kind == "brown":
        k1, k2, k3, t1, t2 = k
        more = k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            x + x * more + t2 * (r2 + 2 * x * x) + 2 * t1 * x * y,
            y + y * more + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y,
        )
    elif kind == "fisheye":
        theta = np.arctan(r)
        scale = (theta + sum(k[i] * theta ** (3 + 2 * i) for i in range(4))) / r
        x, y = x * scale, y * scale
    elif kind == "fisheye1":
        scale = np.arctan(2 * r * np.tan(0.5 * k[0])) / k[0] / r
        x, y = x * scale, y * scale
    return np.stack([FX * x + CENTER[0], FY * y + CENTER[1]], axis=1)


def intrinsic(version, kind):
    """As jsonIO.cpp reads each version; every number is a string."""
    width, height = SIZE
    mm = FX * SENSOR / width
    new = {"pixelRatio": FY / FX, "focalLength": mm}
    if version < (1, 2, 0):
        lens = {"pxFocalLength": FX}
    elif version < (1, 2, 2):
        lens = {"pxFocalLength": [FX, FY]}
    elif version < (1, 2, 5):
        lens = {"focalLength": mm, "pixelRatio": FX / FY}
    else:
        lens = new if version < (1, 2, 11) else new | {"focalLength": mm * FY / FX}
    x, y = CENTER
    point = [x, y] if version < (1, 2, 1) else [x - width / 2, y - height / 2]
    types = {"type": OLD.get(kind, kind)}
    if version >= (1, 2, 8):
        types = {"type": "pinhole", "distortionType": kind, "undistortionType": "none"}
    return {
        "intrinsicId": 5, "width": width, "height": height, "sensorWidth": SENSOR,
        "sensorHeight": 24, "principalPoint": point, "distortionParams": DISTORTIONS[kind] or "",
        **types, **lens,
    }  # fmt: skip


def strings(value):
    if isinstance(value, dict):
        return {key: strings(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [strings(each) for each in value]
    return value if isinstance(value, str) else repr(value)


def transform(cam_from_world, center):
    return {"rotation": cam_from_world.T.ravel().tolist(), "center": center.tolist()}


def scene_of(made, version=(1, 2, 11), kind="brown", posed=4):
    views = [
        {"viewId": 70 + i, "poseId": 70 + i, "intrinsicId": 5, "path": f"D:/photos/{name}",
         "width": SIZE[0], "height": SIZE[1], "metadata": {"Make": "Canon"}}
        for i, name in enumerate(NAMES)
    ]  # fmt: skip
    poses = [
        {"poseId": 70 + i, "pose": {"transform": transform(made.rotations[i], made.centers[i])}}
        for i in range(posed)
    ]
    structure = [
        {"landmarkId": i, "color": rgb.tolist(), "X": xyz.tolist()}
        for i, (xyz, rgb) in enumerate(zip(made.xyz, made.rgb, strict=True))
    ]
    return {"version": version, "views": views, "intrinsics": [intrinsic(version, kind)],
            "poses": poses, "structure": structure}  # fmt: skip


def write(path, content):
    path.parent.mkdir(exist_ok=True, parents=True)
    path.write_text(json.dumps(strings(content), indent=4))


@pytest.mark.parametrize("kind", DISTORTIONS)
def test_projections_are_those_of_the_distortion(tmp_path, kind):
    made = made_cameras()
    write_photographs(tmp_path / "images", NAMES)
    write(tmp_path / "cameras.sfm", scene_of(made, kind=kind))
    for path in (tmp_path, tmp_path / "cameras.sfm"):
        read = load(path)
        assert read.source.format == "meshroom"
        assert kinds(read) == ({"lens-distortion"} if kind != "none" else set())
        expected = [alicevision(made.rays(i), kind, DISTORTIONS[kind]) for i in range(4)]
        check_projections(read, made, expected, NAMES)
        np.testing.assert_array_equal(read.points.xyz, made.xyz.astype(np.float32))
        np.testing.assert_array_equal(read.points.rgb, made.rgb)


@pytest.mark.parametrize("version", [(1, 2, 0), (1, 2, 1), (1, 2, 4), (1, 2, 6), (1, 2, 8)])
def test_projections_are_the_same_in_each_version(tmp_path, version):
    made = made_cameras()
    write_photographs(tmp_path / "images", NAMES)
    write(tmp_path / "cameras.sfm", scene_of(made, version, "radialk3"))
    expected = [alicevision(made.rays(i), "radialk3", DISTORTIONS["radialk3"]) for i in range(4)]
    check_projections(load(tmp_path), made, expected, NAMES)


def test_views_of_a_rig(tmp_path):
    made = made_cameras()
    write_photographs(tmp_path / "images", NAMES)
    content = scene_of(made, kind="none")
    # The second camera's pose is that of the first as the rig, and its own within the rig.
    rotation = made.rotations[1] @ made.rotations[0].T
    center = made.rotations[0] @ (made.centers[1] - made.centers[0])
    content["views"][1] |= {
        "poseId": 70, "rigId": 3, "subPoseId": 0, "isPoseIndependant": "false"
    }  # fmt: skip
    content["rigs"] = [
        {"rigId": 3, "subPoses": [{"status": "estimated", "pose": transform(rotation, center)}]}
    ]
    write(tmp_path / "cameras.sfm", content)
    expected = [alicevision(made.rays(i), "none", []) for i in range(4)]
    check_projections(load(tmp_path), made, expected, NAMES)


def test_what_is_left_out_is_stated(tmp_path):
    made = made_cameras()
    write_photographs(tmp_path / "images", NAMES)
    write(tmp_path / "cameras.sfm", scene_of(made, posed=3))
    (tmp_path / "cameraInit.sfm").write_text('{"version": ["1", "2", "11"]}')
    read = load(tmp_path)
    assert kinds(read) == {"missing-poses", "lens-distortion", "several-models"}
    assert [image.name for image in read.images] == NAMES[:3]


def test_damaged_files_are_one_error(tmp_path):
    made = made_cameras()
    write_photographs(tmp_path / "images", NAMES)
    path = tmp_path / "cameras.sfm"
    write(path, scene_of(made, posed=0))
    with pytest.raises(SceneNotFoundError, match="4 without a pose"):
        load(tmp_path)
    write(path, scene_of(made))
    text = path.read_text()
    for damaged in (
        text[:-20], text.replace('"undistortionType": "none"', '"undistortionType": "3deradial4"'),
        text.replace('"type": "pinhole"', '"type": "equidistant"'), text.replace('"36.0"', '"0.0"'),
        text.replace('"center"', '"centre"'), text.replace('"views"', '"view"'),
    ):  # fmt: skip
        path.write_text(damaged)
        with pytest.raises(SceneFormatError, match=r"cameras\.sfm"):
            load(tmp_path)
