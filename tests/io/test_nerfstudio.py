"""transforms.json in and out: the same world, the same pixels, one error for what is malformed."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from PIL import Image as PilImage

from splatseed.camera import Camera, Intrinsics, rotation_from_quat
from splatseed.errors import OutputError, SceneFormatError, SplatseedError
from splatseed.io import load_scene, write_scene
from splatseed.io.nerfstudio import read_transforms
from splatseed.io.ply import read_ply, write_ply
from splatseed.pointcloud import PointCloud
from splatseed.similarity import Similarity

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
LEGACY = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])


def opengl_pose(image, applied):
    square = np.vstack([applied, [0, 0, 0, 1]])
    return square @ image.camera.world_from_cam @ FLIP


def nerfstudio_camera(meta, frame):
    """The frame's camera by nerfstudio's conventions, in OpenCV axes."""
    values = {**meta, **frame}
    K = np.array([[values["fl_x"], 0, values["cx"]], [0, values["fl_y"], values["cy"]], [0, 0, 1]])
    world_from_cam = np.array(frame["transform_matrix"]) @ FLIP
    return Camera(K, values["w"], values["h"], np.linalg.inv(world_from_cam))


def write_json(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def content(model):
    """A valid file with all there can be."""
    frames = [
        {"file_path": f"images/{im.name}", "transform_matrix": opengl_pose(im, APPLIED).tolist()}
        for im in model.images
    ]
    lens = {"fl_x": 500.0, "fl_y": 510.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480, "k1": 0.1}
    return {**lens, "applied_transform": APPLIED.tolist(), "frames": frames, "aabb_scale": 16}


@pytest.fixture
def in_front(scene_dir, rng):
    """The scene with a cloud before its first camera."""
    scene = load_scene(scene_dir)
    camera = scene.images[0].camera
    uv = rng.uniform((0, 0), (camera.width, camera.height), (200, 2))
    xyz = camera.unproject(uv, rng.uniform(2, 6, 200))
    return scene.replace(points=PointCloud(xyz, np.zeros((200, 3), np.uint8)))


def test_cloud_lands_on_the_same_pixels_through_nerfstudios_cameras(in_front, tmp_path):
    write_scene(in_front, tmp_path / "out", format="transforms")
    meta = json.loads((tmp_path / "out/transforms.json").read_text())
    cloud = read_ply(tmp_path / "out" / meta["ply_file_path"])
    assert len(cloud) == 200
    for image, frame in zip(in_front.images, meta["frames"], strict=True):
        expected_uv, expected_depth = image.camera.project(in_front.points.xyz)
        uv, depth = nerfstudio_camera(meta, frame).project(cloud.xyz)
        np.testing.assert_allclose(depth, expected_depth, rtol=1e-5, atol=1e-5)
        seen = expected_depth > 0.1
        np.testing.assert_allclose(uv[seen], expected_uv[seen], atol=1e-2)
    assert np.isfinite(expected_uv).any()


def test_from_colmap_to_transforms_and_back_is_the_same_scene(scene_dir, tmp_path):
    scene = load_scene(scene_dir)
    write_scene(scene, tmp_path / "a", format="transforms")
    there = load_scene(tmp_path / "a")
    assert there.source.format == "transforms"
    assert there.intrinsics[0].model == "PINHOLE"
    assert there.intrinsics[1].params == scene.intrinsics[1].params
    write_scene(there, tmp_path / "b", format="colmap")
    back = load_scene(tmp_path / "b")
    assert [im.name for im in back.images] == [im.name for im in scene.images]
    assert [im.image_id for im in back.images] == [im.image_id for im in scene.images]
    for ours, theirs in zip(back.images, scene.images, strict=True):
        uv, _ = ours.camera.project(back.points.xyz)
        expected, depth = theirs.camera.project(scene.points.xyz)
        np.testing.assert_allclose(uv[depth > 0.2], expected[depth > 0.2], rtol=1e-4, atol=1e-2)


def test_content_that_was_read_is_kept(content, scene_dir, tmp_path):
    content |= {"aabb_scale": 16, "train_filenames": ["x"], "ply_file_path": "cloud.ply"}
    content["frames"][0]["sharpness"] = 3.5
    path = write_json(scene_dir / "transforms.json", content)
    write_ply(scene_dir / "cloud.ply", load_scene(scene_dir).points)
    (scene_dir / "images_2").mkdir()
    scene = load_scene(path)
    write_scene(scene, tmp_path / "out")
    out = json.loads((tmp_path / "out/transforms.json").read_text())
    assert out == {**content, "ply_file_path": "sparse_pc.ply"}
    assert (tmp_path / "out/images_2").is_dir()
    again = load_scene(tmp_path / "out")
    np.testing.assert_array_equal(again.points.xyz, scene.points.xyz)
    np.testing.assert_array_equal(again.points.rgb, scene.points.rgb)
    for a, b in zip(again.images, scene.images, strict=True):
        np.testing.assert_array_equal(a.camera.cam_from_world, b.camera.cam_from_world)


def test_paths_out_of_the_folder_still_resolve(content, scene_dir, tmp_path):
    folder = scene_dir / "poses"
    for frame in content["frames"]:
        frame["file_path"] = f"../{frame['file_path']}"
    path = write_json(folder / "transforms.json", content)
    write_ply(folder / "sparse_pc.ply", load_scene(scene_dir).points)
    write_scene(load_scene(path), tmp_path / "out")
    frames = json.loads((tmp_path / "out/transforms.json").read_text())["frames"]
    assert all((tmp_path / "out" / frame["file_path"]).is_file() for frame in frames)


def test_named_ply_is_taken_as_it_is_and_colmaps_points_are_brought_over(content, scene_dir):
    scene = load_scene(scene_dir)
    path = write_json(scene_dir / "transforms.json", content)
    expected = scene.points.xyz @ APPLIED[:, :3].T.astype(np.float32)
    loaded = load_scene(path)
    np.testing.assert_array_equal(loaded.points.xyz, expected)
    for ours, theirs in zip(loaded.images, scene.images, strict=True):
        _, depth = ours.camera.project(loaded.points.xyz)
        _, expected_depth = theirs.camera.project(scene.points.xyz)
        np.testing.assert_allclose(depth, expected_depth, atol=1e-5)
    write_ply(scene_dir / "given.ply", scene.points)
    write_json(path, content | {"ply_file_path": "given.ply"})
    np.testing.assert_array_equal(load_scene(path).points.xyz, scene.points.xyz)
    write_json(path, content | {"ply_file_path": "gone.ply"})
    scene = load_scene(path)
    np.testing.assert_array_equal(scene.points.xyz, expected)
    assert any("gone.ply" in text for text in scene.warnings)


@pytest.mark.parametrize("transform", [LEGACY, np.eye(4)[:3]], ids=["legacy", "none"])
def test_cameras_tell_how_colmaps_points_are_brought_over(content, scene_dir, model, transform):
    del content["applied_transform"]
    for frame, image in zip(content["frames"], model.images, strict=True):
        frame["transform_matrix"] = opengl_pose(image, transform).tolist()
    points = load_scene(write_json(scene_dir / "transforms.json", content)).points
    expected = model.tracks.xyz @ transform[:, :3].T
    np.testing.assert_allclose(points.xyz, expected, rtol=1e-6)


def test_instant_ngps_recentred_poses_are_fitted(content, scene_dir, model, rng):
    """Its converter turns the up axis, moves what cameras look at to 0, and scales by one
    number."""
    del content["applied_transform"]
    rotation = rotation_from_quat(rng.normal(size=4))
    moved = Similarity(0.37, rotation, rng.normal(size=3))
    for frame, image in zip(content["frames"], model.images, strict=True):
        pose = image.camera.world_from_cam.copy()
        pose[:3, :3] = rotation @ pose[:3, :3]
        pose[:3, 3] = moved.points(image.camera.center[None])[0] + 1e-4 * rng.normal(size=3)
        frame["transform_matrix"] = (pose @ FLIP).tolist()
    scene = load_scene(write_json(scene_dir / "transforms.json", content))
    np.testing.assert_allclose(scene.points.xyz, moved.points(model.tracks.xyz), atol=2e-3)
    assert any("turned, moved and scaled by 0.37" in text for text in scene.warnings)


def test_colmap_points_of_another_world_are_refused(content, scene_dir, rng):
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] += rng.normal()
    path = write_json(scene_dir / "transforms.json", content)
    with pytest.raises(SceneFormatError, match=r"ply_file_path.*COLMAP scene"):
        load_scene(path)
    for i, frame in enumerate(content["frames"]):
        frame["file_path"] = f"images/other{i}.png"
    write_json(path, content)
    assert any("askew" in text for text in load_scene(path).warnings)


def test_instant_ngp_without_extension_size_or_focal_length(tmp_path):
    (tmp_path / "images").mkdir()
    PilImage.new("RGB", (64, 48)).save(tmp_path / "images/0001.png")
    frame = {"file_path": "./images/0001", "transform_matrix": np.eye(4).tolist()}
    path = write_json(tmp_path / "transforms.json", {"camera_angle_x": 1.2, "frames": [frame]})
    scene = load_scene(path, require_points=False)
    image = scene.images[0]
    assert image.name == "0001.png"
    assert scene.source.image_dir == tmp_path / "images"
    focal_length = 32 / math.tan(0.6)
    assert image.intrinsics == Intrinsics(
        1, "PINHOLE", 64, 48, (focal_length, focal_length, 32.0, 24.0)
    )
    np.testing.assert_allclose(rotation_from_quat(image.quat), np.diag([1, -1, -1]), atol=1e-12)
    with pytest.raises(SplatseedError, match="--poses-from"):
        load_scene(path)
    (tmp_path / "images/0001.png").unlink()
    with pytest.raises(SceneFormatError, match="w and h"):
        load_scene(path, require_points=False)


def test_images_beside_the_file_without_extension_are_linked(tmp_path, model):
    folder = tmp_path / "scene"
    folder.mkdir()
    PilImage.new("RGB", (64, 48)).save(folder / "0001.png")
    frame = {"file_path": "./0001", "transform_matrix": np.eye(4).tolist()}
    path = write_json(folder / "transforms.json", {"camera_angle_x": 1.2, "frames": [frame]})
    write_ply(folder / "sparse_pc.ply", model.points)
    scene = load_scene(path)
    assert scene.images[0].name == "0001.png"
    write_scene(scene, tmp_path / "a")
    assert (tmp_path / "a/0001.png").is_file()
    write_scene(scene, tmp_path / "b", format="colmap")
    assert (tmp_path / "b/images/0001.png").is_file()
    assert [p.name for p in (tmp_path / "b/images").iterdir()] == ["0001.png"]


@pytest.mark.parametrize(
    ("lens", "name", "terms"),
    [
        ({}, "PINHOLE", ()),
        ({"k1": 0.1, "p2": 0.2}, "OPENCV", (0.1, 0, 0, 0.2)),
        ({"k1": 0.1, "k3": 0.3}, "FULL_OPENCV", (0.1, 0, 0, 0, 0.3, 0, 0, 0)),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.4}, "OPENCV_FISHEYE", (0, 0, 0, 0.4)),
        ({"is_fisheye": True, "k1": 0.1}, "OPENCV_FISHEYE", (0.1, 0, 0, 0)),
        ({"camera_model": "PINHOLE"}, "PINHOLE", ()),
    ],
)
def test_lens_models(content, tmp_path, lens, name, terms):
    del content["k1"]
    camera = read_transforms(write_json(tmp_path / "t.json", content | lens)).intrinsics[0]
    assert (camera.model, camera.params) == (name, (500.0, 510.0, 320.0, 240.0, *terms))


def test_frames_may_have_cameras_of_their_own(content, tmp_path):
    content["frames"][2] |= {"fl_x": 700.0, "w": 800, "k1": 0.0}
    transforms = read_transforms(write_json(tmp_path / "t.json", content))
    assert [im.intrinsics.camera_id for im in transforms.images] == [1, 1, 2, 1]
    camera = transforms.images[2].intrinsics
    assert (camera.model, camera.width, camera.params[:2]) == ("PINHOLE", 800, (700.0, 510.0))


def test_unused_distortion_is_told(content, tmp_path):
    path = write_json(tmp_path / "t.json", content | {"k4": 0.1})
    assert any("k4 of 4 frames" in text for text in read_transforms(path).warnings)


def test_lens_that_nerfstudio_has_not_is_refused(scene_dir, tmp_path):
    scene = load_scene(scene_dir)
    lens = Intrinsics(9, "FOV", 800, 600, (700.0, 700.0, 400.0, 300.0, 0.5))
    images = (replace(scene.images[0], intrinsics=lens),)
    with pytest.raises(OutputError, match="FOV"):
        write_scene(scene.replace(images=images), tmp_path / "out", format="transforms")
    assert not (tmp_path / "out").exists()


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=6,
)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_value_in_any_field_gives_our_errors_alone(content, tmp_path, data):
    odd = copy.deepcopy(content)
    target = data.draw(st.sampled_from([odd, odd["frames"][0]]))
    key = data.draw(st.sampled_from([*target, "k2", "camera_model", "colmap_im_id", "p1"]))
    target[key] = data.draw(ANY_JSON)
    try:
        transforms = read_transforms(write_json(tmp_path / "t.json", odd))
    except SplatseedError:
        return
    assert all(np.isfinite(im.camera.cam_from_world).all() for im in transforms.images)


COUNTS = {"train": 5, "val": 2, "test": 3}


@pytest.fixture
def lego(tmp_path, rng):
    """As NeRF's data set has it: paths without suffix, one angle of view, names alike in each
    part."""
    root = tmp_path / "lego"
    for part, count in COUNTS.items():
        (root / part).mkdir(parents=True)
        frames = []
        for i in range(count):
            pose = np.eye(4)
            pose[:3, 3] = rng.normal(size=3)
            frames.append({"file_path": f"./{part}/r_{i}", "transform_matrix": pose.tolist()})
            PilImage.new("RGBA", (40, 30)).save(root / part / f"r_{i}.png")
        content = {"camera_angle_x": 0.7, "frames": frames}
        (root / f"transforms_{part}.json").write_text(json.dumps(content))
    write_ply(
        root / "points3d.ply", PointCloud(rng.normal(size=(9, 3)), np.zeros((9, 3), np.uint8))
    )
    return root


@pytest.mark.parametrize(
    ("change", "frame"),
    [
        ({"frames": []}, {}),
        ({"fl_x": None}, {}),
        ({"fl_x": -5}, {}),
        ({"fl_x": 0}, {}),
        ({"fl_x": float("nan")}, {}),
        ({"w": 0}, {}),
        ({"camera_model": "EQUIRECTANGULAR"}, {}),
        ({"applied_transform": [[1, 0], [0, 1]]}, {}),
        ({}, {"file_path": None}),
        ({}, {"file_path": "images/left/image000.jpg"}),  # the first's
        ({}, {"transform_matrix": None}),
        ({}, {"transform_matrix": (2 * np.eye(4)).tolist()}),
        ({}, {"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}),
        ({}, {"transform_matrix": np.full((4, 4), np.nan).tolist()}),
    ],
)
def test_malformed_files_and_frames_are_named(content, tmp_path, change, frame):
    content["frames"][1] |= frame
    path = write_json(tmp_path / "t.json", content | change)
    with pytest.raises(SceneFormatError, match=r"t\.json, frame 2" if frame else r"t\.json"):
        read_transforms(path)


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b"\xff\xfe{", b"[" * 100_000, b"3"])
def test_what_is_not_json_is_one_error(tmp_path, data):
    (tmp_path / "t.json").write_bytes(data)
    with pytest.raises(SceneFormatError, match=r"t\.json"):
        read_transforms(tmp_path / "t.json")


def _parts(scene):
    return [[image.name for image in part] for part in scene.split(8)]


def test_both_files_are_one_scene_with_their_split(lego):
    scene = load_scene(lego)
    wanted = [[f"{part}/r_{i}.png" for i in range(COUNTS[part])] for part in ("train", "test")]
    assert _parts(scene) == wanted
    assert len({image.image_id for image in scene.images}) == 8
    assert len(scene.intrinsics) == 1
    assert len(scene.points) == 9
    assert scene.has_photographs
    assert not [each for each in scene.warnings if "missing" in each or "outside" in each]
    assert "transforms_train.json" in scene.listed.sentence


@pytest.mark.parametrize("layout", ["auto", "colmap"])
def test_an_output_has_the_same_split_and_cameras(layout, lego, tmp_path):
    scene = load_scene(lego)
    again = load_scene(write_scene(scene, tmp_path / "out", format=layout).path)
    assert _parts(again) == _parts(scene)
    assert again.has_photographs
    pixels = {}
    for each in (scene, again):
        seen = [
            im.camera.project(each.points.xyz.astype(np.float64))[0]
            for im in sorted(each.images, key=lambda image: image.name)
        ]
        pixels[id(each)] = np.nan_to_num(np.stack(seen))
    np.testing.assert_allclose(*pixels.values(), rtol=1e-3, atol=1e-2)
