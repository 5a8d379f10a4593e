"""Structure-from-Motion on a corner of three textured walls, whose geometry is known."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.ndimage import gaussian_filter, map_coordinates

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.errors import (
    InputError,
    MissingDependencyError,
    OutputError,
    ParameterError,
    ReconstructionError,
    SceneFormatError,
    SceneNotFoundError,
)
from splatseed.io import load_scene
from splatseed.io.rgbd import load_rgbd
from splatseed.pointcloud import PointCloud
from splatseed.process import tasks
from splatseed.scene import Image, Scene, Split
from splatseed.sfm import reconstruct, triangulate
from splatseed.sfm.features import Run
from splatseed.sfm.orientation import clear_orientation
from splatseed.sfm.photos import Photo
from splatseed.sfm.settings import MatcherName, Settings
from splatseed.sfm.solving.mapping import _advice

pycolmap = pytest.importorskip("pycolmap")

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
PINHOLE = Intrinsics(7, "PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
EMPTY = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))


def look_at_corner(center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation of cam_from_world for a camera at ``center`` facing (1, 1, 1)."""
    forward = np.array([1.0, 1.0, 1.0]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return rotation, -rotation @ center


def photograph(image: Image, textures: np.ndarray) -> np.ndarray:
    """The walls x = 0, y = 0 and z = 0 as the camera sees them, uint8 [H, W, 3]."""
    camera = image.camera
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    at_depth_1 = camera.unproject(np.stack([u.ravel(), v.ravel()], 1), np.ones(u.size))
    rays = at_depth_1 - camera.center
    distance = np.where(rays < 0, -camera.center / np.minimum(rays, -1e-9), np.inf)
    wall = distance.argmin(axis=1)
    hit = camera.center + rays * distance.min(axis=1)[:, None]
    across = np.array([[1, 2], [0, 2], [0, 1]])[wall]
    st = np.take_along_axis(hit, across, axis=1) * 90.0
    color = np.zeros(len(hit))
    for k, texture in enumerate(textures):
        color[wall == k] = map_coordinates(texture, st[wall == k].T, order=1, mode="wrap")
    return np.repeat(color.reshape(HEIGHT, WIDTH, 1), 3, axis=2).round().astype(np.uint8)


def noise_texture(rng: np.random.Generator, size: int) -> np.ndarray:
    """Noise of several scales, so that SIFT finds blobs of many sizes."""
    layers = [gaussian_filter(rng.standard_normal((size, size)), s, mode="wrap") for s in (1, 3, 7)]
    return np.clip(128 + 45 * sum(layer / layer.std() for layer in layers), 0, 255)


@pytest.fixture(scope="module")
def posed() -> Scene:
    angles = np.linspace(0.55, 1.0, 6)
    images = []
    for i, angle in enumerate(angles):
        center = np.array([4 * np.cos(angle), 4 * np.sin(angle), 2.6 + 0.3 * (-1) ** i])
        rotation, translation = look_at_corner(center)
        quat = quat_from_rotation(rotation)
        images.append(Image(f"view{i}.png", 40 - i, PINHOLE, quat, translation))
    return Scene(EMPTY, tuple(images), (PINHOLE,))


@pytest.fixture(scope="module")
def photos(posed: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photos")
    textures = np.stack([noise_texture(np.random.default_rng(k), 512) for k in range(3)])
    for image in posed.images:
        PilImage.fromarray(photograph(image, textures)).save(folder / image.name)
    return folder


def files_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def add_noise_images(folder: Path, num: int) -> None:
    for i in range(num):
        texture = noise_texture(np.random.default_rng(100 + i), 256).astype(np.uint8)
        PilImage.fromarray(texture).save(folder / f"other{i}.png")


def aligned_error(centers: np.ndarray, true: np.ndarray) -> float:
    """RMS distance [scene units] of camera centres after the best similarity transform."""
    a, b = centers - centers.mean(axis=0), true - true.mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    scale = np.trace(np.diag(s) @ flip) / (a**2).sum()
    return float(np.sqrt(((scale * a @ (u @ flip @ vt).T - b) ** 2).sum(axis=1).mean()))


def test_reconstruct_finds_the_cameras(posed: Scene, photos: Path, tmp_path: Path) -> None:
    seen: list[tuple[str, float]] = []
    report = reconstruct(
        photos,
        tmp_path / "scene",
        camera_model="SIMPLE_RADIAL",
        on_progress=lambda stage, done: seen.append((stage, done)),
    )

    assert (report.registered, report.total, report.unregistered) == (6, 6, ())
    assert files_below(report.path) == {
        *(f"images/{image.name}" for image in posed.images),
        *(f"sparse/0/{n}.bin" for n in ("cameras", "images", "points3D", "rigs", "frames")),
        "splatseed.json",
    }
    model = pycolmap.Reconstruction(report.path / "sparse" / "0")
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    assert model.num_points3D() == report.num_points > 200
    assert model.compute_mean_track_length() == pytest.approx(report.mean_track_length)
    stored = np.mean([point.error for point in model.points3D.values()])
    assert stored == pytest.approx(report.mean_reprojection_error)
    assert stored < 1.0
    centers = np.array(
        [model.find_image_with_name(i.name).projection_center() for i in posed.images]
    )
    true = np.array([image.camera.center for image in posed.images])
    assert aligned_error(centers, true) < 0.05  # the cameras are 4 from the corner

    stages = list(dict.fromkeys(stage for stage, _ in seen))
    assert stages == ["features", "matching", "mapping", "undistortion"] == list(report.seconds)
    for stage in stages:
        fractions = [done for s, done in seen if s == stage]
        assert fractions[0] == 0.0
        assert fractions[-1] == 1.0
    manifest = json.loads((report.path / "splatseed.json").read_text())
    assert manifest["report"]["registered"] == 6


def test_triangulate_keeps_the_poses_and_finds_the_walls(
    posed: Scene, photos: Path, tmp_path: Path
) -> None:
    known = posed.replace(images=posed.images[1:])  # the first photograph has no pose
    test = frozenset(["view2.png"])
    split = Split(frozenset(image.name for image in known.images) - test, test, "two files")
    known = known.replace(listed=split)
    report = triangulate(photos, known, tmp_path / "scene", matcher="sequential")
    again = load_scene(report.path).listed
    assert (again.train, again.test) == (split.train, split.test)

    assert (report.registered, report.total, report.unregistered) == (5, 6, ("view0.png",))
    model = pycolmap.Reconstruction(report.path / "sparse" / "0")
    for image in known.images:
        pose = model.find_image_with_name(image.name).cam_from_world().matrix()
        np.testing.assert_allclose(pose, image.camera.cam_from_world[:3], atol=1e-12)
        copy = report.path / "images" / image.name
        assert copy.read_bytes() == (photos / image.name).read_bytes()
    (camera,) = model.cameras.values()
    assert tuple(camera.params) == PINHOLE.params
    xyz = np.array([point.xyz for point in model.points3D.values()])
    assert len(xyz) > 200
    assert np.median(np.abs(xyz).min(axis=1)) < 0.01


def test_triangulate_repeats_itself_and_undistorts(
    posed: Scene, photos: Path, tmp_path: Path
) -> None:
    params = (FOCAL, WIDTH / 2, HEIGHT / 2, 0.01)
    radial = Intrinsics(1, "SIMPLE_RADIAL", WIDTH, HEIGHT, params)
    images = tuple(
        Image(i.name, i.image_id, radial, i.quat, i.translation) for i in posed.images[:3]
    )
    scene = Scene(EMPTY, images, (radial,))
    first, second = (
        triangulate(photos, scene, tmp_path / name, seed=3, max_image_size=240).path
        for name in ("first", "second")
    )
    model = pycolmap.Reconstruction(first / "sparse" / "0")
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    for name in files_below(first) - {"splatseed.json"}:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_a_known_lens_is_believed(posed: Scene, photos: Path, tmp_path: Path) -> None:
    """Coefficients above 1, as a Kinect's, which COLMAP takes for a calibration gone wrong."""
    cancel = (0.0, 0.0, 0.0, 0.0, 1.2, 0.0, 0.0, 1.2)  # the rational model's k3 = k6
    lens = Intrinsics(7, "FULL_OPENCV", WIDTH, HEIGHT, (*PINHOLE.params, *cancel))
    images = tuple(replace(image, intrinsics=lens) for image in posed.images)
    report = triangulate(photos, posed.replace(images=images), tmp_path / "scene")
    assert report.num_points > 100
    assert report.mean_reprojection_error < 1


def test_fewer_than_half_registered_is_an_error_that_names_them(
    photos: Path, tmp_path: Path
) -> None:
    mixed = tmp_path / "mixed"
    shutil.copytree(photos, mixed)
    add_noise_images(mixed, 8)
    with pytest.raises(ReconstructionError, match=r"at least half of the 14 images") as caught:
        reconstruct(mixed, tmp_path / "scene", camera_model="SIMPLE_RADIAL")
    assert "found 6 in the largest" in str(caught.value)
    assert "other0.png" in caught.value.found
    assert "exhaustive" not in caught.value.fix  # it was
    assert "view0.png" not in caught.value.found
    assert {path.name for path in tmp_path.iterdir()} == {"mixed"}


def test_no_model_is_an_error_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("photos", "temporary"):
        (tmp_path / name).mkdir()
    add_noise_images(tmp_path / "photos", 3)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    with pytest.raises(ReconstructionError, match="a model of the 3 images"):
        reconstruct(tmp_path / "photos", tmp_path / "scene")
    assert {path.name for path in tmp_path.iterdir()} == {"photos", "temporary"}
    assert list((tmp_path / "temporary").iterdir()) == []  # COLMAP's log is ours alone


@pytest.mark.parametrize(
    ("matcher", "model", "size", "told"),
    [
        ("exhaustive", "PINHOLE", 640, "or take out those of other places."),
        ("exhaustive", "OPENCV", 640, "places or try a simpler camera_model such as"),
        ("exhaustive", "PINHOLE", 639, "places or find features at a larger max_image_size."),
        ("sequential", "SIMPLE_RADIAL", 9999, "places or try the exhaustive matcher."),
    ],
)
def test_only_what_was_not_done_is_advised(
    matcher: MatcherName, model: str, size: int, told: str
) -> None:
    run = Run(None, Settings(matcher, "cpu", size, 0, -1), Path(), Path())
    assert told in _advice(run, [Photo("a.png", 640, 480), Photo("b.png", 480, 320)], model)


def test_wrong_poses_are_an_error(posed: Scene, photos: Path, tmp_path: Path) -> None:
    same_place = tuple(
        Image(i.name, i.image_id, PINHOLE, posed.images[0].quat, posed.images[0].translation)
        for i in posed.images
    )
    with pytest.raises(ReconstructionError, match="points from the 6 posed images"):
        triangulate(photos, posed.replace(images=same_place), tmp_path / "scene")


def test_interrupt_leaves_nothing(photos: Path, tmp_path: Path) -> None:
    def interrupt(stage: str, done: float) -> None:
        if stage == "features" and done >= 0:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(photos, tmp_path / "scene", on_progress=interrupt)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("child", "told"),
    [
        ("import os; os.write(2, b'  what():  disk full'); os.abort()", "SIGABRT: disk full"),
        ("raise SystemExit('gone')", "exit code 1: gone"),
        ("print('not a pickle')", "exit code 0"),
    ],
)
def test_a_dying_worker_is_one_clear_error(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, child: str, told: str
) -> None:
    monkeypatch.setattr(tasks, "_PROGRAM", child)
    with pytest.raises(ReconstructionError, match=told):
        reconstruct(photos, tmp_path / "scene")
    assert not list(tmp_path.iterdir())


def test_bad_image_folders(photos: Path, tmp_path: Path) -> None:
    folder, out = tmp_path / "photos", tmp_path / "scene"
    with pytest.raises(SceneNotFoundError, match="found nothing"):
        reconstruct(folder, out)
    folder.mkdir()
    with pytest.raises(SceneNotFoundError, match="no files"):
        reconstruct(folder, out)
    (folder / "a.heic").touch()
    with pytest.raises(SceneNotFoundError, match=r"other kinds: \.heic"):
        reconstruct(folder, out)
    shutil.copy(photos / "view0.png", folder / "a.png")
    with pytest.raises(SceneNotFoundError, match="at least 2 photographs"):
        reconstruct(folder, out)
    PilImage.new("I;16", (WIDTH, HEIGHT)).save(folder / "depth.png")
    with pytest.raises(
        SceneNotFoundError, match=r"found 1 and 1 of 16-bit .* \(depth\.png\) and 1"
    ):
        reconstruct(folder, out)
    (folder / "b.png").write_bytes(b"not an image")
    with pytest.raises(SceneFormatError, match=r"b\.png to be a readable image"):
        reconstruct(folder, out)
    assert not out.exists()


def test_pictures_of_an_output_are_no_photographs(photos: Path, tmp_path: Path) -> None:
    scene = tmp_path / "scene"
    (scene / "images").mkdir(parents=True)
    shutil.copy(photos / "view0.png", scene / "preview.png")
    shutil.copy(photos / "view1.png", scene / "preview_cells.png")
    (scene / "splatseed.json").write_text('{"command": "upsample"}')
    with pytest.raises(SceneNotFoundError, match=f"Name its photographs: {scene}/images"):
        reconstruct(scene, tmp_path / "out")
    (scene / "images").rmdir()
    (scene / "splatseed.json").write_text('{"command": "train"}')
    with pytest.raises(SceneNotFoundError, match="found what splatseed train wrote"):
        reconstruct(scene, tmp_path / "out")


def test_photographs_are_told_before_any_work(photos: Path, tmp_path: Path) -> None:
    shutil.copytree(photos, tmp_path / "photos" / "below")

    PilImage.new("I;16", (WIDTH, HEIGHT)).save(tmp_path / "photos" / "depth.png")

    (tmp_path / "photos" / "phone.heic").touch()

    def stop(names: list[str], left_out: dict[str, list[str]]) -> None:
        raise KeyError(len(names), names[0], *left_out.values())

    with pytest.raises(
        KeyError, match=r"6, 'below/view0\.png', \['depth\.png'\], \['phone\.heic'\]"
    ):
        reconstruct(tmp_path / "photos", tmp_path / "scene", on_photos=stop)
    assert not (tmp_path / "scene").exists()


def test_a_truncated_photograph_is_refused(photos: Path, tmp_path: Path) -> None:
    shutil.copy(photos / "view0.png", tmp_path / "a.png")
    with PilImage.open(photos / "view0.png") as image:
        image.save(tmp_path / "b.jpg")
    whole = (tmp_path / "b.jpg").read_bytes()
    (tmp_path / "b.jpg").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(SceneFormatError, match=r"b\.jpg to be a readable image"):
        reconstruct(tmp_path, tmp_path.with_name("scene"))


@pytest.mark.parametrize("order", ["II", "MM"])
def test_exif_orientation_is_cleared_and_pixels_are_kept(tmp_path: Path, order: str) -> None:
    pixels = noise_texture(np.random.default_rng(0), 64).astype(np.uint8)
    exif = PilImage.Exif()
    exif.endian = "<" if order == "II" else ">"
    exif[0x0110], exif[0x0112] = "a camera", 6
    (tmp_path / "sub").mkdir()
    for name in ("turned.jpg", "sub/turned.JPG", "plain.jpg"):
        extra = {} if name == "plain.jpg" else {"exif": exif}
        PilImage.fromarray(pixels).save(tmp_path / name, format="JPEG", **extra)
    (tmp_path / "turned.jpg").chmod(0o444)
    before = {name: (tmp_path / name).read_bytes() for name in files_below(tmp_path)}
    clear_orientation(tmp_path)
    for name, old in before.items():
        new = (tmp_path / name).read_bytes()
        changed = sum(a != b for a, b in zip(old, new, strict=True))
        assert changed == (0 if name == "plain.jpg" else 1)  # 6 becomes 1
        with PilImage.open(tmp_path / name) as image:
            tags = image.getexif()
            assert tags.get(0x0112, 1) == 1
            assert name == "plain.jpg" or tags[0x0110] == "a camera"


@pytest.mark.parametrize(
    "options",
    [
        {"matcher": "psychic"},
        {"device": "tpu"},
        {"camera_model": "POLAROID"},
        {"max_image_size": 0},
        {"seed": -1},
        {"threads": 0},
    ],
)
def test_options_out_of_range(photos: Path, tmp_path: Path, options: dict[str, object]) -> None:
    with pytest.raises(ParameterError, match=next(iter(options))):
        reconstruct(photos, tmp_path / "scene", **options)


def test_an_output_in_the_way_is_kept(photos: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("keep")
    with pytest.raises(OutputError):
        reconstruct(photos, tmp_path, overwrite=True)
    with pytest.raises(OutputError):
        reconstruct(photos, photos / "scene")
    assert (tmp_path / "mine.txt").read_text() == "keep"


def test_poses_that_do_not_fit(posed: Scene, photos: Path, tmp_path: Path) -> None:
    renamed = tuple(
        Image(f"x{i.name}", i.image_id, PINHOLE, i.quat, i.translation) for i in posed.images
    )
    with pytest.raises(SceneNotFoundError, match="Names must be equal"):
        triangulate(photos, posed.replace(images=renamed), tmp_path / "scene")
    half = Intrinsics(1, "PINHOLE", WIDTH // 2, HEIGHT // 2, (150.0, 150.0, 80.0, 60.0))
    small = tuple(Image(i.name, i.image_id, half, i.quat, i.translation) for i in posed.images)
    with pytest.raises(SceneFormatError, match="found 320x240"):
        triangulate(photos, posed.replace(images=small), tmp_path / "scene")
    with pytest.raises(InputError):
        triangulate(photos, Scene(EMPTY), tmp_path / "scene")


def test_without_pycolmap_the_error_says_what_to_install(
    photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MissingDependencyError, match=r"-m pip install .*'pycolmap>=4\.0'"):
        reconstruct(photos, tmp_path / "scene")


@pytest.mark.skipif(pycolmap.has_cuda, reason="this pycolmap can use CUDA")
def test_cuda_is_refused_where_there_is_none(photos: Path, tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match="built for the CPU"):
        reconstruct(photos, tmp_path / "scene", device="cuda")


def test_this_process_never_imports_pycolmap() -> None:
    code = "import sys, splatseed.sfm; sys.exit('pycolmap' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_triangulated_points_lie_on_a_real_depth_map(scenes: Path, tmp_path: Path) -> None:
    room = load_rgbd(scenes / "replica" / "room0")
    results = scenes / "replica" / "room0" / "results"
    chosen = room.images[::6]
    (tmp_path / "photos").mkdir()
    for image in chosen:
        shutil.copy(results / image.name, tmp_path / "photos")
    report = triangulate(
        tmp_path / "photos", room.replace(images=chosen), tmp_path / "scene", max_image_size=800
    )
    model = pycolmap.Reconstruction(report.path / "sparse" / "0")
    uv, depth = chosen[0].camera.project(np.array([p.xyz for p in model.points3D.values()]))
    with PilImage.open(results / "depth000000.png") as image:
        measured = np.asarray(image) / 6553.5
    inside = (uv > 0).all(axis=1) & (uv < [1200, 680]).all(axis=1)
    column, row = uv[inside].astype(int).T
    error = np.abs(measured[row, column] - depth[inside])
    assert len(error) > 100
    assert np.median(error) < 0.02  # metres
