"""Panoramas of a made room: poses, points and colours of the scenes that are cut from them."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap")

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io import load_scene
from splatseed.photos.panorama import FACES
from splatseed.sfm import reconstruct, undistort
from splatseed.sfm.colmap import Settings
from splatseed.sfm.panoramas import face_names, find_panoramas, split_of_faces
from splatseed.sfm.photos import find_photos
from splatseed.similarity import fit_similarity

from ..panoramas import poses, render, walls

pytestmark = pytest.mark.usefixtures("pycolmap_here")
NUM, WIDTH = 4, 384
GPANO = b'<rdf:Description GPano:ProjectionType="%b"/>'


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A folder of panoramas, as JPEG."""
    folder = tmp_path_factory.mktemp("walk")
    for k, pose in enumerate(poses(NUM)):
        Image.fromarray(render(pose, WIDTH)).save(folder / f"p{k}.jpg", quality=95)
    return folder


@pytest.fixture(scope="module")
def scene(walk, tmp_path_factory):
    """COLMAP's model of the panoramas, with points on the walls, and their poses for nerfstudio."""
    root = tmp_path_factory.mktemp("scene")
    (root / "sparse" / "0").mkdir(parents=True)
    (root / "images").symlink_to(walk)
    rays = np.random.default_rng(3).normal(size=(40, 3))
    center = np.array([2.0, 2.0, 1.2])
    xyz = center + rays * walls()[0].intersect_parts(center, rays)[0][:, None]
    model, tracks = pycolmap.Reconstruction(), [pycolmap.Track() for _ in xyz]
    lens = pycolmap.Camera(
        camera_id=1, model="EQUIRECTANGULAR", width=WIDTH, height=WIDTH // 2,
        params=[WIDTH, WIDTH // 2],
    )  # fmt: skip
    model.add_camera_with_trivial_rig(lens)
    for k, pose in enumerate(poses(NUM)):
        seen = lens.img_from_cam(xyz @ pose[:3, :3].T + pose[:3, 3], check_cheirality=False)
        image = pycolmap.Image(name=f"p{k}.jpg", keypoints=seen, camera_id=1, image_id=k + 5)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
        for j, track in enumerate(tracks):
            track.add_element(k + 5, j)
    for point, track in zip(xyz, tracks, strict=True):
        model.add_point3D(point, track, np.array([10, 20, 30], np.uint8))
    model.write(root / "sparse" / "0")
    return root


def write_transforms(walk, folder, model):
    """The same poses as ``world_from_cam`` in OpenGL's axes, without points."""
    frames = [
        {
            "file_path": str(walk / f"p{k}.jpg"),
            "transform_matrix": (np.linalg.inv(pose) @ np.diag([1.0, -1, -1, 1])).tolist(),
        }
        for k, pose in enumerate(poses(NUM))
    ]
    stated = {} if model is None else {"camera_model": model}
    (folder / "transforms.json").write_text(json.dumps({**stated, "frames": frames}))
    return folder


def check_faces(scene, tolerance):
    """Six faces a panorama, posed as the panorama and turned as ``FACES`` says."""
    assert len(scene.images) == 6 * NUM
    for k, pose in enumerate(poses(NUM)):
        for face, turn in FACES.items():
            image = scene[f"{face}_p{k}.jpg"]
            expected = turn @ pose[:3]
            np.testing.assert_allclose(image.cam_from_world[:3], expected, atol=tolerance)
            assert image.intrinsics.model == "PINHOLE"
            assert (image.lens.width, image.lens.height) == image.size


def test_a_model_of_panoramas_is_cut(scene, tmp_path):
    """Features stay on their points, to 1e-6 px; all faces of a panorama test, or none."""
    report = undistort(load_scene(scene, panoramas=True), tmp_path / "cut")
    assert [each.kind for each in report.findings] == ["panoramas"]
    cut = load_scene(tmp_path / "cut")
    check_faces(cut, 1e-12)
    assert cut.tracks is not None
    assert len(cut.points) == 40
    assert (cut.tracks.lengths == NUM).all()
    assert cut.tracks.errors.max() < 1e-6
    assert cut.listed is None
    assert (cut.num_viewpoints, cut.default_test_every) == (NUM, 0)
    train, test = cut.split(NUM)
    assert {image.name for image in test} == {f"{face}_p0.jpg" for face in FACES}
    assert len(train) == 6 * (NUM - 1)
    assert cut.masks is None or not cut.masks.files


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "SPHERICAL", None])
def test_transforms_without_points_are_cut(model, walk, tmp_path):
    folder = write_transforms(walk, tmp_path, model)
    scene = load_scene(folder, require_points=False, panoramas=True)
    undistort(scene, tmp_path / "cut")
    check_faces(load_scene(tmp_path / "cut", require_points=False), 1e-6)


def test_other_verbs_name_the_command(scene, tmp_path, splatseed, monkeypatch):
    """Which works: also for a folder "." and for a file."""
    for verb in ("info", "upsample"):
        run = splatseed(verb, scene, *(["-o", tmp_path / "out"] if verb == "upsample" else []))
        assert run.code == 2
        assert f"splatseed undistort {scene} -o {scene}_undistorted" in run.err
    monkeypatch.chdir(scene)
    with pytest.raises(SceneFormatError, match=rf"undistort \. -o {scene}_undistorted"):
        load_scene(".")
    run = splatseed("undistort", ".", "-o", tmp_path / "cut", "--mask-below", "40")
    assert run.code == 0, run.err
    assert "4 panoramas are each cut into 6 photographs of 146 x 146 px" in run.err


@pytest.mark.parametrize(("count", "tests"), [(11, ()), (12, ("00", "08"))])
def test_every_eighth_panorama_is_listed_for_other_trainers(count, tests):
    split = split_of_faces({f"{k:02}.jpg": face_names(f"{k:02}.jpg") for k in range(count)})
    tested = {face for name in tests for face in face_names(f"{name}.jpg")}
    assert (split and (split.test, len(split.train))) == ((tested, 60) if tests else None)


def test_what_is_below_is_masked(scene, tmp_path):
    """All within the angle, in the face below and the lower parts of its neighbours."""
    undistort(load_scene(scene, panoramas=True), tmp_path / "cut", mask_below=42)
    cut = load_scene(tmp_path / "cut")
    assert cut["up_p1.jpg"].read_mask() is None
    for face, turn in FACES.items():
        image = cut[f"{face}_p1.jpg"]
        u, v = np.meshgrid(np.arange(146) + 0.5, np.arange(146) + 0.5)
        rays = np.stack([(u - 73) / image.K[0, 0], (v - 73) / image.K[1, 1], np.ones_like(u)], -1)
        down = (rays @ turn)[..., 1] / np.linalg.norm(rays, axis=-1)
        counts = image.read_mask()
        expected = down < np.cos(np.radians(42))
        assert expected.all() == (face == "up")
        assert (expected if counts is None else counts == expected).all()
    undistort(load_scene(scene, panoramas=True), tmp_path / "more", mask_below=65)
    assert len(load_scene(tmp_path / "more").images) == 5 * NUM  # no face below
    with pytest.raises(ParameterError, match=r"`mask_below` from 0 to 80 degrees; found 90"):
        undistort(load_scene(scene, panoramas=True), tmp_path / "all", mask_below=90)


def test_a_walk_in_panoramas_is_reconstructed(walk, tmp_path):
    """One pose a panorama, to 5 mm in a room of 5 m, and points on its walls."""
    found = []
    report = reconstruct(
        walk, tmp_path / "scene", Settings(threads=1), mask_below=10, note=found.append
    )
    assert (report.registered, report.total) == (6 * NUM, 6 * NUM)
    assert "panoramas" in {each.kind for each in found}
    made = load_scene(report.path)
    truth = poses(NUM)
    fronts = [made[f"front_p{k}.jpg"] for k in range(NUM)]
    centers = np.array([-pose[:3, :3].T @ pose[:3, 3] for pose in truth])
    world = fit_similarity(np.array([image.camera.center for image in fronts]), centers)
    turn = world.matrix[:3, :3] / world.scale
    for k, pose in enumerate(truth):
        for face, rotation in FACES.items():
            image = made[f"{face}_p{k}.jpg"]
            off = world.matrix[:, :3] @ image.camera.center + world.matrix[:, 3] - centers[k]
            assert np.linalg.norm(off) < 0.005
            expected = rotation @ pose[:3, :3] @ turn
            np.testing.assert_allclose(image.cam_from_world[:3, :3], expected, atol=2e-3)
            focal = WIDTH / (2 * np.pi)  # kept
            assert image.intrinsics.params == pytest.approx((focal, focal, 73, 73), abs=1e-12)
    xyz = made.points.xyz.astype(np.float64) @ world.matrix[:, :3].T + world.matrix[:, 3]
    off = walls()[0].distance(xyz)
    assert len(xyz) > 300
    assert np.median(off) < 0.02
    assert np.mean(off < 0.1) > 0.9
    assert made.listed is None
    assert {image.name for image in made.split()[1]} == {f"{face}_p0.jpg" for face in FACES}
    model = pycolmap.Reconstruction(report.path / "sparse" / "0")
    assert (model.num_rigs(), model.num_frames(), model.num_images()) == (1, NUM, 6 * NUM)
    assert made["down_p1.jpg"].read_mask() is not None


def test_panoramas_are_recognised(walk, tmp_path, rng):
    """By XMP, or sides that join; not crops, pairs of fisheyes or uniform backgrounds."""
    panorama = np.asarray(Image.open(walk / "p0.jpg"))
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(WIDTH // 2))
    outside = np.hypot(u % (WIDTH // 2) - 95.5, v - 95.5) > 95
    pictures = {
        "panorama.jpg": panorama,
        "crop.jpg": np.repeat(np.repeat(panorama[40:136, 100:292], 2, axis=0), 2, axis=1),
        "fisheyes.jpg": np.where(outside[..., None], 0, panorama),
        "studio.jpg": np.where((np.abs(u - 192) > 80)[..., None], 250, panorama),
        "square.jpg": panorama[:, :192],
    }
    for name, pixels in pictures.items():
        folder = tmp_path / name.partition(".")[0]
        folder.mkdir()
        Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / name, quality=92)
        (folder / name).hardlink_to(tmp_path / name)
        (folder / f"2_{name}").hardlink_to(tmp_path / name)
        found, _ = find_panoramas(folder, find_photos(folder)[0])
        assert [*found] == (["2_panorama.jpg", name] if name == "panorama.jpg" else [])
    photos, _ = find_photos(tmp_path)
    assert find_panoramas(tmp_path, photos, "none") == ({}, ())
    with pytest.raises(ParameterError, match=r"square\.jpg of 192 x 192"):
        find_panoramas(tmp_path, photos, "all")
    whole, other = GPANO % b"equirectangular", GPANO % b"cylindrical"
    half = whole + b"<GPano:CroppedAreaImageWidthPixels>192</GPano:CroppedAreaImageWidthPixels>"
    half += b'<x GPano:FullPanoWidthPixels="384"/>'
    for name, tag in {"studio": whole, "square": whole, "crop": other, "panorama": half}.items():
        with (tmp_path / name / f"{name}.jpg").open("ab") as file:
            file.write(tag)
    found, (_, part) = find_panoramas(tmp_path, photos)
    studio = ["studio.jpg", "studio/2_studio.jpg", "studio/studio.jpg"]
    assert sorted(found) == studio  # the others show some directions, or do not close
    assert part.severity == "warning"
    assert {name.rpartition("/")[2].removeprefix("2_") for name in part.subjects} == {
        "square.jpg", "crop.jpg", "panorama.jpg",
    }  # fmt: skip


def test_photographs_are_never_overwritten(walk, tmp_path):
    """A folder with panoramas and what was cut from them: links to photographs are not followed."""
    for name in ("p0.jpg", "p1.jpg"):
        (tmp_path / name).write_bytes((walk / name).read_bytes())
    Image.new("RGB", (146, 146)).save(tmp_path / "up_p1.jpg")
    before = (tmp_path / "up_p1.jpg").read_bytes()
    with pytest.raises(ParameterError, match=r"found up_p1\.jpg"):
        reconstruct(tmp_path, tmp_path.parent / "never", panoramas="auto")
    assert (tmp_path / "up_p1.jpg").read_bytes() == before


def test_tracks_of_features_that_are_missing_lose_them(scene, tmp_path):
    """As files with one side of a reference only, or with a photograph that is missing."""
    whole = load_scene(scene, panoramas=True)
    tracks = whole.tracks
    index, ids = tracks.point2d_idx.copy(), tracks.image_ids.copy()
    index[0], ids[5] = 4000, 99
    broken = whole.replace(tracks=replace(tracks, point2d_idx=index, image_ids=ids))
    undistort(broken, tmp_path / "cut")
    cut = load_scene(tmp_path / "cut")
    assert cut.tracks.lengths.tolist() == [NUM - 1, NUM - 1, *[NUM] * 38]
    assert cut.tracks.errors.max() < 1e-6
