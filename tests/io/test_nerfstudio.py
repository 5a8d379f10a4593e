"""transforms.json in and out: the same world, the same pixels, one error for what is malformed."""

from __future__ import annotations

import copy
import json
import math
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from PIL import Image as PilImage

from splatseed.camera import Camera, Intrinsics, rotation_from_quat
from splatseed.errors import OutputError, SceneFormatError, SplatseedError
from splatseed.io import load_scene, write_scene
from splatseed.io.masks import read_mask
from splatseed.io.nerfstudio import pair_centers, read_transforms
from splatseed.io.ply import read_ply, write_ply
from splatseed.pointcloud import PointCloud
from splatseed.similarity import Similarity

from ..findings import texts
from .checks import CHARACTERS

FIELDS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
APPLIED = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
LEGACY = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])


def opengl_pose(image, applied):
    square = np.vstack([applied, [0, 0, 0, 1]])
    return (square @ image.camera.world_from_cam @ FLIP).tolist()


def write_json(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


@pytest.fixture
def content(model):
    """A valid file with all there can be."""
    frames = [
        {"file_path": f"images/{im.name}", "transform_matrix": opengl_pose(im, APPLIED)}
        for im in model.images
    ]
    lens = {"fl_x": 500.0, "fl_y": 510.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480, "k1": 0.1}
    return {**lens, "applied_transform": APPLIED.tolist(), "frames": frames, "aabb_scale": 16}


def test_cloud_lands_on_the_same_pixels_through_nerfstudios_cameras(scene_dir, rng, tmp_path):
    scene = load_scene(scene_dir)
    first = scene.images[0].camera
    uv = rng.uniform((0, 0), (first.width, first.height), (200, 2))
    xyz = first.unproject(uv, rng.uniform(2, 6, 200))
    scene = scene.replace(points=PointCloud(xyz, np.zeros((200, 3), np.uint8)))
    write_scene(scene, tmp_path / "out", format="transforms")
    again = load_scene(tmp_path / "out")
    assert [lens.model for lens in again.intrinsics] == ["PINHOLE", "OPENCV"]
    assert again.intrinsics[1].params == scene.intrinsics[1].params
    ids = [[(im.name, im.image_id) for im in each.images] for each in (scene, again)]
    assert ids[0] == ids[1]
    meta = json.loads((tmp_path / "out/transforms.json").read_text())
    cloud = read_ply(tmp_path / "out" / meta["ply_file_path"])
    for image, frame in zip(scene.images, meta["frames"], strict=True):
        expected_uv, expected_depth = image.camera.project(scene.points.xyz)
        fx, fy, cx, cy, *size = ({**meta, **frame}[key] for key in FIELDS)
        cam_from_world = np.linalg.inv(np.array(frame["transform_matrix"]) @ FLIP)
        theirs = Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), *size, cam_from_world)
        uv, depth = theirs.project(cloud.xyz)
        np.testing.assert_allclose(depth, expected_depth, rtol=1e-5, atol=1e-5)
        seen = expected_depth > 0.1
        np.testing.assert_allclose(uv[seen], expected_uv[seen], atol=1e-2)


def test_content_that_was_read_is_kept(content, scene_dir, tmp_path):
    content |= {"aabb_scale": 16, "train_filenames": ["x"], "ply_file_path": "cloud.ply"}
    content["frames"][0]["sharpness"] = 3.5
    path = write_json(scene_dir / "transforms.json", content)
    write_ply(scene_dir / "cloud.ply", load_scene(scene_dir).points)
    (scene_dir / "images_2").mkdir()
    scene = load_scene(path)
    write_scene(scene, tmp_path / "out")
    out = json.loads((tmp_path / "out/transforms.json").read_text())
    assert out == {**content, "camera_model": "OPENCV", "ply_file_path": "sparse_pc.ply"}
    assert (tmp_path / "out/images_2").is_dir()
    again = load_scene(tmp_path / "out")
    assert_same_cloud(again.points, scene.points)
    for a, b in zip(again.images, scene.images, strict=True):
        np.testing.assert_array_equal(a.camera.cam_from_world, b.camera.cam_from_world)
    for frame in content["frames"]:  # paths that lead out still resolve
        frame["file_path"] = f"../{frame['file_path']}"
    (scene_dir / "poses").mkdir()
    shutil.copy(scene_dir / "cloud.ply", scene_dir / "poses")
    path = write_json(scene_dir / "poses/t.json", content)
    out = write_scene(load_scene(path), tmp_path / "o2").path
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    assert all((out / frame["file_path"]).is_file() for frame in frames)
    lens = Intrinsics(9, "FOV", 800, 600, (700.0, 700.0, 400.0, 300.0, 0.5))
    odd = replace(load_scene(scene_dir), images=(replace(scene.images[0], intrinsics=lens),))
    with pytest.raises(OutputError, match="FOV"):
        write_scene(odd, tmp_path / "odd", format="transforms")


def assert_same_cloud(actual, expected):
    np.testing.assert_array_equal(actual.xyz, expected.xyz)
    np.testing.assert_array_equal(actual.rgb, expected.rgb)


def test_a_named_ply_is_taken_as_it_is(content, scene_dir, model):
    write_ply(scene_dir / "given.ply", model.points)
    path = scene_dir / "transforms.json"
    write_json(path, content | {"ply_file_path": "given.ply"})
    assert_same_cloud(load_scene(path).points, model.points)
    write_json(path, content | {"ply_file_path": "gone.ply"})
    assert any("gone.ply" in text for text in texts(load_scene(path)))


@pytest.mark.parametrize("transform", [APPLIED, LEGACY, np.eye(4)[:3]])
def test_colmaps_points_are_brought_over_as_told_or_as_cameras_tell(
    content, scene_dir, model, transform
):
    if transform is not APPLIED:
        del content["applied_transform"]
    for frame, image in zip(content["frames"], model.images, strict=True):
        frame["transform_matrix"] = opengl_pose(image, transform)
    points = load_scene(write_json(scene_dir / "transforms.json", content)).points
    np.testing.assert_allclose(points.xyz, model.tracks.xyz @ transform[:, :3].T, rtol=1e-6)


def test_instant_ngps_recentred_poses_are_fitted(content, scene_dir, model, rng):
    """Its converter turns the up axis, moves what cameras look at to 0, and scales."""
    del content["applied_transform"]
    rotation = rotation_from_quat(rng.normal(size=4))
    moved = Similarity(0.37, rotation, rng.normal(size=3))
    for frame, image in zip(content["frames"], model.images, strict=True):
        pose = image.camera.world_from_cam @ FLIP
        pose[:3, :3] = rotation @ pose[:3, :3]
        pose[:3, 3] = moved.points(image.camera.center[None])[0] + 1e-4 * rng.normal(size=3)
        frame["transform_matrix"] = pose.tolist()
    scene = load_scene(write_json(scene_dir / "transforms.json", content))
    np.testing.assert_allclose(scene.points.xyz, moved.points(model.tracks.xyz), atol=2e-3)
    assert any("0.37" in text for text in texts(scene))


def test_cameras_are_the_same_by_their_paths_or_by_names_that_are_unique(model):
    first, second = (replace(i, name=f"cam{n}/0.jpg") for n, i in enumerate(model.images[:2]))
    for others, same in (([second, first], 2), ([replace(second, name="other/0.jpg")], 0)):
        pairs = pair_centers(
            *([(im.name, im.camera.center) for im in each] for each in ([first, second], others))
        )
        assert len(pairs) == same
        assert all(np.array_equal(*pair) for pair in pairs)


def test_cameras_of_two_kinds_are_refused(scene_dir, tmp_path):
    first, *rest = load_scene(scene_dir).images
    fisheye = Intrinsics(99, "OPENCV_FISHEYE", 96, 72, (80.0, 80.0, 48.0, 36.0, 0.1, 0.0, 0.0, 0.0))
    mixed = load_scene(scene_dir).replace(images=(replace(first, intrinsics=fisheye), *rest))
    with pytest.raises(OutputError, match="of one kind"):
        write_scene(mixed, tmp_path / "out", format="transforms")


def test_colmap_points_of_another_world_are_refused(content, scene_dir, rng):
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] += rng.normal()
    path = write_json(scene_dir / "transforms.json", content)
    with pytest.raises(SceneFormatError, match=r"ply_file_path.*COLMAP scene"):
        load_scene(path)


@pytest.mark.parametrize("folder", ["images/", ""])
def test_instant_ngp_without_extension_size_or_focal_length(folder, tmp_path, model):
    root = tmp_path / "scene"
    (root / folder).mkdir(parents=True)
    PilImage.new("RGB", (64, 48)).save(root / folder / "0001.png")
    frame = {"file_path": f"./{folder}0001", "transform_matrix": np.eye(4).tolist()}
    path = write_json(root / "transforms.json", {"camera_angle_x": 1.2, "frames": [frame]})
    write_ply(root / "sparse_pc.ply", model.points)
    scene = load_scene(path)
    (image,) = scene.images
    assert (image.name, scene.source.image_dir) == ("0001.png", root / folder)
    focal = 32 / math.tan(0.6)
    assert image.intrinsics == Intrinsics(1, "PINHOLE", 64, 48, (focal, focal, 32.0, 24.0))
    np.testing.assert_allclose(rotation_from_quat(image.quat), np.diag([1, -1, -1]), atol=1e-12)
    write_scene(scene, tmp_path / "a")
    assert (tmp_path / f"a/{folder}0001.png").is_file()
    write_json(path, {"camera_angle_x": 45, "frames": [frame]})
    with pytest.raises(SceneFormatError, match="in radians"):
        load_scene(path)
    write_json(path, {"camera_angle_x": 1.2, "frames": [frame]})
    (root / folder / "0001.png").unlink()
    with pytest.raises(SceneFormatError, match="w and h"):
        load_scene(path)


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


ANY_JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(CHARACTERS, max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(CHARACTERS, max_size=3), inner)
    ),
    max_leaves=6,
)


@settings(
    max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
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


DIAGONALS = ([2.0, 2, 2, 2], [1.0, 1, -1, 1], [0.0, 1, 1, 1])


@pytest.mark.parametrize(
    ("size", "stated"), [((640, 320), {"camera_model": "PINHOLE"}), ((640, 480), {})]
)
def test_a_file_without_focal_lengths_is_not_guessed(content, tmp_path, size, stated):
    """Unless all that it states fits panoramas."""
    path = tmp_path / "t.json"
    lens = dict.fromkeys(("fl_x", "fl_y", "cx", "cy")) | dict(zip("wh", size, strict=True))
    path.write_text(json.dumps({**content, **lens, **stated}))
    expected = r"a focal length \(fl_x in pixels.* frame 1 .*; found none\. .*EQUIRECTANGULAR"
    with pytest.raises(SceneFormatError, match=expected):
        read_transforms(path)


@pytest.mark.parametrize(
    ("change", "frame"),
    [
        *(({"fl_x": value}, {}) for value in (None, -5, 0, float("nan"))),
        *(({"w": 0}, {}), ({"frames": []}, {}), ({"camera_model": "ORTHOGRAPHIC"}, {})),
        ({"applied_transform": [[1, 0], [0, 1]]}, {}),
        *(({}, {"file_path": value}) for value in (None, "images/left/image000.jpg")),  # used
        ({}, {"transform_matrix": None}),
        *(({}, {"transform_matrix": np.diag(d).tolist()}) for d in DIAGONALS),
        *((data, None) for data in (b"", b"{", b"[]", b"\xff\xfe{", b"[" * 100_000, b"3")),
    ],
)
def test_malformed_files_and_frames_are_named(content, tmp_path, change, frame):
    content["frames"][1] |= frame or {}
    path = tmp_path / "t.json"
    path.write_bytes(change if frame is None else json.dumps(content | change).encode())
    with pytest.raises(SceneFormatError, match=r"t\.json, frame 2" if frame else r"t\.json"):
        read_transforms(path)


@pytest.mark.parametrize("named", [True, False])
def test_masks_of_blenders_files(named, tmp_path):
    """Named by the frames, or in a folder; transparent pixels stay empty space."""
    root, pixels = tmp_path / "lego", np.full((30, 40), 255, np.uint8)
    pixels[:, :10] = 0
    for part in ("train", "test"):
        for folder in (part, f"masks/{part}"):
            (root / folder).mkdir(parents=True)
        PilImage.new("RGBA", (40, 30)).save(root / part / "r_0.png")
        mask = f"{part}_0.png" if named else f"masks/{part}/r_0.png"
        PilImage.fromarray(pixels).save(root / mask)
        frame = {"file_path": f"./{part}/r_0", "transform_matrix": np.eye(4).tolist()}
        frames = [{**frame, **({"mask_path": mask} if named else {})}]
        write_json(root / f"transforms_{part}.json", {"camera_angle_x": 0.7, "frames": frames})
    scene = load_scene(root, require_points=False)
    for image in scene.images:
        np.testing.assert_array_equal(read_mask(scene.masks, image.name, image.path), pixels > 0)


@pytest.mark.parametrize("layout", ["auto", "colmap"])
def test_blenders_files_are_one_scene_and_so_is_its_output(layout, tmp_path, rng):
    """As in NeRF's data set: paths without suffix, one angle of view, names alike in each part."""
    root, counts = tmp_path / "lego", {"train": 5, "val": 2, "test": 3}
    for part, count in counts.items():
        (root / part).mkdir(parents=True)
        frames = []
        for i in range(count):
            pose = np.eye(4)
            pose[:3, 3] = rng.normal(size=3)
            frames.append({"file_path": f"./{part}/r_{i}", "transform_matrix": pose.tolist()})
            PilImage.new("RGBA", (40, 30)).save(root / part / f"r_{i}.png")
        write_json(root / f"transforms_{part}.json", {"camera_angle_x": 0.7, "frames": frames})
    points = PointCloud(rng.normal(size=(9, 3)), np.zeros((9, 3), np.uint8))
    write_ply(root / "points3d.ply", points)
    scene = load_scene(root)
    again = load_scene(write_scene(scene, tmp_path / "out", format=layout).path)
    linked = [each for each in (tmp_path / "out/images").rglob("*") if each.is_symlink()]
    assert not any(each.is_dir() for each in linked)  # which gsplat's examples do not enter
    wanted = [[f"{part}/r_{i}.png" for i in range(counts[part])] for part in ("train", "test")]
    pixels = []
    for each in (scene, again):
        assert [[image.name for image in part] for part in each.split(8)] == wanted
        assert len({image.image_id for image in each.images}) == 8
        assert (len(each.intrinsics), len(each.points), each.has_photographs) == (1, 9, True)
        ordered = sorted(each.images, key=lambda image: image.name)
        seen = [im.camera.project(each.points.xyz.astype(np.float64))[0] for im in ordered]
        pixels.append(np.nan_to_num(np.stack(seen)))
    np.testing.assert_allclose(*pixels, rtol=1e-3, atol=1e-2)
    assert [each.masks.alpha for each in (scene, again)] == [False, False]  # black, not masked
    assert not [each for each in texts(scene) if "missing" in each or "outside" in each]


SHARED = {"w": 200, "h": 100, "fl_x": 150.0, "fl_y": 160.0, "cx": 90.0, "cy": 60.0, "k1": 0.1}


@pytest.mark.parametrize(
    ("shared", "own", "kind", "params"),
    [
        ({}, {}, "OPENCV", (150, 160, 90, 60, 0.1, 0, 0, 0)),
        ({}, {"camera_angle_x": math.pi / 2}, "OPENCV", (100, 100, 90, 60, 0.1, 0, 0, 0)),
        ({}, {"x_fov": 90}, "OPENCV", (100, 100, 90, 60, 0.1, 0, 0, 0)),
        ({}, {"fl_x": 120, "fl_y": None}, "OPENCV", (120, 120, 90, 60, 0.1, 0, 0, 0)),
        ({}, {"w": 100, "h": 50}, "OPENCV", (75, 80, 45, 30, 0.1, 0, 0, 0)),
        ({}, {"w": 100, "h": 100}, "OPENCV", (150, 160, 45, 60, 0.1, 0, 0, 0)),  # cropped
        ({}, {"w": 100, "h": 50, "cx": 50, "fl_x": 8}, "OPENCV", (8, 8, 50, 30, 0.1, 0, 0, 0)),
        ({}, {"k1": 0.2, "p1": 0.3}, "OPENCV", (150, 160, 90, 60, 0.2, 0, 0.3, 0)),
        ({}, {"camera_model": "PINHOLE"}, "PINHOLE", (150, 160, 90, 60)),
        ({}, {"is_fisheye": True}, "OPENCV_FISHEYE", (150, 160, 90, 60, 0, 0, 0, 0)),
        ({"is_fisheye": True}, {"is_fisheye": False}, "PINHOLE", (150, 160, 90, 60)),
        ({"is_fisheye": True}, {"camera_model": "OPENCV"}, "PINHOLE", (150, 160, 90, 60)),
        ({"camera_model": "RADIAL"}, {"is_fisheye": False}, "OPENCV", (150, 160, 90, 60, 0.1)),
        ({"fl_x": None, "x_fov": 90}, {"fl_x": 9}, "OPENCV", (9, 9, 90, 60, 0.1, 0, 0, 0)),
    ],
)
def test_a_frame_replaces_what_it_states_in_any_way(content, tmp_path, shared, own, kind, params):
    content = {"frames": content["frames"], **SHARED, **shared}
    content["frames"][0] |= own
    cameras = {im.name: im.intrinsics for im in _images(content, tmp_path)}
    first, *others = cameras.values()
    assert first.model == kind
    np.testing.assert_allclose(first.params[: len(params)], params)
    assert not any(first.params[len(params) :])
    del content["frames"][0]
    assert others == [im.intrinsics for im in _images(content, tmp_path)]


def _images(content, folder):
    images = read_transforms(write_json(folder / "t.json", content)).images
    return [replace(im, intrinsics=replace(im.intrinsics, camera_id=1)) for im in images]


def test_an_output_states_each_frames_intrinsics_where_they_differ(content, tmp_path, model):
    content["frames"][0]["camera_angle_x"] = math.pi / 2
    path = write_json(tmp_path / "in/transforms.json", content)
    write_ply(path.parent / "sparse_pc.ply", model.points)
    write_scene(load_scene(path), tmp_path / "out")
    out = json.loads((tmp_path / "out/transforms.json").read_text())
    assert "fl_x" not in out
    assert "cx" in out
    assert [frame["fl_x"] for frame in out["frames"][:2]] == [pytest.approx(320), 500]
