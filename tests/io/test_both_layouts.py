"""A scene from a transforms.json is written in both layouts: one world, and none disturbs another.

Which layout and which files a trainer takes is from its loader's source (docs/formats.md).
"""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.io import load_scene, write_scene
from splatseed.io.ply import read_ply
from splatseed.pointcloud import PointCloud

from ..findings import texts

LENSES = {
    "pinhole": Intrinsics(1, "PINHOLE", 640, 480, (500.0, 510.0, 318.0, 243.0)),
    "opencv": Intrinsics(
        1, "OPENCV", 640, 480, (500.0, 510.0, 318.0, 243.0, 0.08, -0.01, 1e-3, -2e-3)
    ),
    "opencv_fisheye": Intrinsics(
        1, "OPENCV_FISHEYE", 640, 480, (300.0, 310.0, 318.0, 243.0, 0.05, 0.01, -0.002, 1e-3)
    ),
}
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@pytest.fixture
def capture(scene_dir, model, tmp_path):
    """A function that makes a transforms.json scene with a lens, with poses of six digits."""

    def make(lens="pinhole", move=0.0, folder="images") -> Path:
        images = tuple(replace(im, intrinsics=LENSES[lens]) for im in model.images)
        scene = load_scene(scene_dir).replace(images=images, intrinsics=(LENSES[lens],))
        root = write_scene(scene, tmp_path / "capture", format="transforms", copy_images=True).path
        for image in images:
            PilImage.new("RGB", (640, 480), "teal").save(root / "images" / image.name)
        path = root / "transforms.json"
        content = json.loads(path.read_text())
        for frame in content["frames"]:
            pose = np.array(frame["transform_matrix"]).round(6)
            pose[:3, 3] += move
            frame["transform_matrix"] = pose.tolist()
            frame["file_path"] = frame["file_path"].replace("images/", f"{folder}/")
        (root / "images").rename(root / folder)
        points = read_ply(root / "sparse_pc.ply")
        assert not move or np.float64(move) == np.float32(move)
        for name in ("sparse_pc.ply", "pointcloud.ply", "splatseed.json"):
            (root / name).unlink()
        text = [f"{x} {y} {z} 9 8 7" for x, y, z in points.xyz.astype(np.float64) + move]
        properties = [f"property double {axis}" for axis in "xyz"]
        properties += [f"property uchar {name}" for name in ("red", "green", "blue")]
        head = ["ply", "format ascii 1.0", f"element vertex {len(text)}", *properties]
        (root / "sparse_pc.ply").write_text("\n".join([*head, "end_header", *text, ""]))
        path.write_text(json.dumps(content))
        return root

    return make


@pytest.fixture
def seeded(rng):
    """A function that adds points to a scene folder's and writes it with the usual layout."""

    def write(root, out, **options) -> Path:
        scene = load_scene(root)
        xyz = scene.images[0].camera.unproject(rng.uniform(0, 480, (30, 2)), rng.uniform(1, 3, 30))
        new = PointCloud(
            xyz, rng.integers(0, 256, xyz.shape).astype(np.uint8), np.ones(30, np.uint8)
        )
        scene = scene.with_points(PointCloud.concatenate(scene.points, new))
        return write_scene(scene, out, **options).path

    return write


def project_by_json(out):
    """Pixels of a folder's PLY by its transforms.json, through pycolmap's lens; and its colours."""
    meta = json.loads((out / "transforms.json").read_text())
    cloud, pixels = read_ply(out / meta["ply_file_path"]), {}
    for frame in meta["frames"]:
        lens = {**meta, **frame}
        terms = ("k1", "k2", "k3", "k4") if "FISHEYE" in lens["camera_model"] else ()
        terms = terms or ("k1", "k2", "p1", "p2")
        size = {"width": int(lens["w"]), "height": int(lens["h"])}
        params = [float(lens.get(key, 0)) for key in ("fl_x", "fl_y", "cx", "cy", *terms)]
        camera = pycolmap.Camera(model=lens["camera_model"], params=params, **size)
        cam_from_world = np.linalg.inv(np.array(frame["transform_matrix"]) @ FLIP)
        local = cloud.xyz.astype(np.float64) @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        pixels[Path(frame["file_path"]).name] = in_front(camera, local)
    return pixels, cloud


def project_by_model(out):
    """Pixels of the points of a folder's COLMAP model by its own cameras, by pycolmap."""
    model = pycolmap.Reconstruction(out / "sparse/0")
    points = [model.points3D[i] for i in sorted(model.points3D)]
    xyz, rgb = (np.array([getattr(p, name) for p in points]) for name in ("xyz", "color"))
    pixels = {}
    for image in model.images.values():
        matrix = image.cam_from_world().matrix()
        pixels[Path(image.name).name] = in_front(
            model.cameras[image.camera_id], xyz @ matrix[:, :3].T + matrix[:, 3]
        )
    return pixels, xyz, rgb


def in_front(camera, local):
    """Pixels of points in a camera's axes, NaN behind or far off axis, where lenses fold."""
    seen = (local[:, 2] > 0.2) & (np.abs(local[:, :2]).max(axis=1) < local[:, 2])
    return np.where(seen[:, None], camera.img_from_cam(np.where(seen[:, None], local, 1.0)), np.nan)


@pytest.mark.parametrize(("lens", "move"), [*((name, 0.0) for name in LENSES), ("opencv", 2**20)])
def test_both_layouts_have_the_same_cameras_and_points(lens, move, capture, seeded, tmp_path):
    out = seeded(capture(lens, move), tmp_path / "out")
    by_json, cloud = project_by_json(out)
    by_model, xyz, rgb = project_by_model(out)
    assert (out / "recenter.json").is_file() == bool(move)
    np.testing.assert_array_equal(xyz.astype(np.float32), cloud.xyz)
    np.testing.assert_array_equal(rgb, cloud.rgb)
    assert len(cloud) == 40
    assert by_json.keys() == by_model.keys()
    count = 0
    for name, pixels in by_json.items():
        np.testing.assert_allclose(by_model[name], pixels, atol=1e-3)
        count += np.isfinite(pixels[:, 0]).sum()
    assert count > 20
    scene = load_scene(out / "sparse/0")
    assert {image.intrinsics.model for image in scene.images} == {lens.upper()}


def files_of_brush(out):
    """All files as Brush lists them, through links."""
    found = (Path(top) / name for top, _, names in os.walk(out, followlinks=True) for name in names)
    return sorted(path.relative_to(out) for path in found)


@pytest.mark.parametrize("folder", ["images", "rgb"])
@pytest.mark.parametrize("copy", [False, True])
def test_each_trainer_finds_its_photographs_and_points(folder, copy, capture, seeded, tmp_path):
    root = capture(folder=folder)
    (root / "depths/left").mkdir(parents=True)  # of other suffixes
    (root / "depths/left/image000.png").write_bytes(b"")
    out = seeded(root, tmp_path / "out", copy_images=copy)
    if copy:
        root.rename(tmp_path / "moved")
        out = out.rename(tmp_path / "out_moved")
    names = [image.name for image in pycolmap.Reconstruction(out / "sparse/0").images.values()]
    meta = json.loads((out / "transforms.json").read_text())
    assert meta["camera_model"]  # OpenSplat throws without
    for name, frame in zip(sorted(names), meta["frames"], strict=True):
        assert (out / "images" / name).is_file()  # graphdeco, gsplat, LichtFeld
        assert (out / frame["file_path"]).samefile(out / "images" / name)  # nerfstudio, OpenSplat
        among = [p for p in files_of_brush(out) if f"/{p.as_posix()}".endswith(f"/{name}")]
        assert (out / min(among)).samefile(out / "images" / name)
    clouds = {path.read_bytes() for path in out.rglob("*.ply")}
    assert len(clouds) == 1  # whichever Brush takes
    assert {path.name for path in out.glob("*.ply")} == {"sparse_pc.ply", "pointcloud.ply"}
    scene = load_scene(out)
    assert scene.source.transforms_path == out / "transforms.json"
    assert scene.points.num_original == 10
    assert not scene.findings
    again = write_scene(scene, tmp_path / "again")
    assert again.layout == "both"


def test_masks_and_split_are_found_in_both_layouts(capture, seeded, tmp_path):
    root = capture()
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    (root / "cut/left").mkdir(parents=True)
    for i, frame in enumerate(content["frames"]):
        mask = np.full((480, 640), 255, np.uint8)
        mask[: 10 + i] = 0
        frame["mask_path"] = f"cut/left/m{i}.png"
        PilImage.fromarray(mask).save(root / frame["mask_path"])
    content["test_frames"] = [content["frames"].pop()]
    path.write_text(json.dumps(content))
    out = seeded(root, tmp_path / "out")
    scenes = [load_scene(out), load_scene(out / "sparse/0")]
    assert scenes[0].listed.test == scenes[1].listed.test == {"left/image003.jpg"}
    for scene in scenes:
        rows = []
        for name in sorted(scene.masks.files):
            with PilImage.open(scene.masks.files[name]) as mask:
                rows.append(int((np.asarray(mask)[:, 0] == 0).sum()))
        assert rows == [10, 11, 12, 13]


@pytest.mark.parametrize("why", ["depth", "images"])
def test_a_layout_that_would_disturb_is_left_out(why, capture, seeded, tmp_path):
    root = capture(folder="rgb" if why == "images" else "images")
    if why == "depth":  # Brush would train on them
        (root / "depths/left").mkdir(parents=True)
        (root / "depths/left/image001.JPG").write_bytes(b"")
    else:
        (root / "images").mkdir()
    scene = load_scene(root)
    report = write_scene(scene, tmp_path / "out")
    assert report.layout == "transforms"
    assert not (report.path / "sparse").exists()
    (note,) = texts(report)
    assert "COLMAP's layout was left out" in note
    assert ("depths" in note) == (why == "depth")
    other = write_scene(scene, tmp_path / "colmap", format="colmap")
    assert any("depths" in note for note in texts(other)) == (why == "depth")


@pytest.mark.parametrize("layout", ["auto", "transforms"])
@pytest.mark.parametrize("named", ["PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "RADIAL"])
def test_lens_models_have_the_names_that_trainers_know(named, layout, capture, tmp_path):
    """Brush (crates/brush-dataset/src/formats/nerfstudio.rs) takes OPENCV and OPENCV_FISHEYE of
    those that nerfstudio knows (CAMERA_MODEL_TO_TYPE), and PERSPECTIVE, which nerfstudio does not.
    """
    root = capture("opencv" if named == "RADIAL" else "pinhole")
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    distorted = named == "RADIAL"
    if not distorted:
        content = {
            key: value for key, value in content.items() if key not in {"k1", "k2", "p1", "p2"}
        }
    path.write_text(json.dumps({**content, "camera_model": named}))
    scene = load_scene(root)
    out = write_scene(scene, tmp_path / "out", format=layout).path
    meta = json.loads((out / "transforms.json").read_text())
    terms = [meta.get(key) for key in ("k1", "k2", "p1", "p2")]
    wanted = list(LENSES["opencv"].params[4:]) if distorted else [0, 0, 0, 0]
    assert meta["camera_model"] == "OPENCV"
    assert terms == wanted or named == "PERSPECTIVE"
    assert load_scene(out).intrinsics == scene.intrinsics


def test_a_frame_without_distortion_keeps_none(capture, tmp_path):
    """Beside others that share one; and the others keep theirs."""
    root = capture("opencv")
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    content["k3"] = 0.01
    content["frames"][1]["camera_model"] = "PINHOLE"
    path.write_text(json.dumps(content))
    scene = load_scene(root)
    out = write_scene(scene, tmp_path / "out").path
    frame = json.loads((out / "transforms.json").read_text())["frames"][1]
    assert frame["camera_model"] == "OPENCV"
    assert [frame[key] for key in ("k1", "k2", "k3", "p1", "p2")] == [0, 0, 0, 0, 0]
    again = load_scene(out)
    assert [i.intrinsics for i in again.images] == [i.intrinsics for i in scene.images]
    assert not again.images[1].intrinsics.has_distortion


def test_fields_that_a_trainer_needs_are_added(capture, tmp_path):
    root = capture()
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    lens = {key: content.pop(key) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model")}
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".jpg")
    angles = {
        f"camera_angle_{axis}": 2 * np.arctan(lens[size] / 2 / lens[f"fl_{axis}"])
        for axis, size in (("x", "w"), ("y", "h"))
    }
    path.write_text(json.dumps({**content, **angles, "frames": content["frames"][::2]}))
    out = write_scene(load_scene(root), tmp_path / "out").path
    meta = json.loads((out / "transforms.json").read_text())
    assert meta["camera_model"] == "OPENCV"
    for frame in meta["frames"]:
        assert (out / frame["file_path"]).is_file()
        assert frame["fl_x"] == pytest.approx(500)
        assert frame["fl_y"] == pytest.approx(510)
        assert [frame[key] for key in ("w", "h", "cx", "cy")] == [640, 480, 320, 240]
