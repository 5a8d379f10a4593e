"""A scene is found and read wherever it lies; what is odd is told, what is wrong is one error."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed import upsample
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import colmap, load_scene
from splatseed.io.cleaning import clean_scene
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud
from splatseed.scene import LeftOut, Scene

from ..findings import texts


def rewrite_points(scene_dir, xyz):
    rgb = np.zeros((len(xyz), 3), np.uint8)
    path = scene_dir / "sparse/0/points3D.bin"
    colmap.write_points3d(path, PointCloud(np.asarray(xyz, np.float64), rgb), None)


def warnings_of(path):
    return " ".join(texts(load_scene(path)))


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_model_is_found_in_its_usual_places(scene_dir, model, place):
    moved = scene_dir.with_name("moved")
    shutil.copytree(scene_dir / "sparse/0", moved / place)
    shutil.copytree(scene_dir / "images", moved / "images")
    for named in (moved, moved / place):
        scene = load_scene(named)
        found = (scene.source.root, scene.source.model_dir, scene.source.image_dir)
        assert found == (moved, moved / place, moved / "images")
        np.testing.assert_array_equal(scene.points.rgb, model.points.rgb)
        np.testing.assert_array_equal(scene.tracks.xyz, model.tracks.xyz)


def test_photographs_are_where_at_least_half_of_them_are(scene_dir):
    """A folder that lacks a few is not replaced: the next may hold reduced or distorted copies."""
    shutil.copytree(scene_dir / "images", scene_dir / "input")
    (scene_dir / "images/left/image000.jpg").unlink()
    assert load_scene(scene_dir).source.image_dir == scene_dir / "images"
    for number in (1, 2):
        (scene_dir / f"images/left/image00{number}.jpg").rename(scene_dir / f"{number}.jpg")
    assert load_scene(scene_dir).source.image_dir == scene_dir / "input"
    shutil.rmtree(scene_dir / "input")
    named = scene_dir.rename(scene_dir.with_name("colmap"))  # as nerfstudio's folder of a model
    assert load_scene(named).source.image_dir == named / "images"


def test_binary_goes_before_text_and_text_before_ply(scene_dir, model):
    folder = scene_dir / "sparse/0"
    lines = "".join(f"{i} 0 {i} 1 7 7 7 0.5\n" for i in range(10))
    (folder / "points3D.txt").write_text(lines)
    write_ply(folder / "points3D.ply", model.points.replace(rgb=np.full((10, 3), 9, np.uint8)))
    assert load_scene(scene_dir).source.points_path.suffix == ".bin"
    assert "undistort" in warnings_of(scene_dir)
    (folder / "points3D.bin").unlink()
    assert (load_scene(scene_dir).points.rgb == 7).all()
    (folder / "points3D.txt").unlink()
    scene = load_scene(scene_dir)
    assert (scene.points.rgb == 9).all()
    assert (scene.tracks, len(scene.images)) == (None, 4)


def test_sparse_goes_before_transforms_json_and_that_before_nerfstudios_colmap(scene_dir):
    frame = {"file_path": "images/left/image000.jpg", "transform_matrix": np.eye(4).tolist()}
    path = scene_dir / "transforms.json"
    path.write_text(json.dumps({"fl_x": 500, "ply_file_path": "a.ply", "frames": [frame]}))
    write_ply(scene_dir / "a.ply", load_scene(scene_dir).points)
    assert load_scene(scene_dir).source.format == "colmap"
    assert "transforms.json" in warnings_of(scene_dir)
    assert load_scene(path).source.format == "transforms"
    (scene_dir / "colmap").mkdir()
    (scene_dir / "sparse").rename(scene_dir / "colmap/sparse")
    assert load_scene(scene_dir).source.format == "transforms"
    path.unlink()
    assert load_scene(scene_dir).source.format == "colmap"


def test_model_without_images_keeps_cameras_and_drops_tracks(scene_dir, model):
    folder = scene_dir / "sparse/0"
    (folder / "images.bin").write_bytes(bytes(8))
    assert f"{folder / 'images.bin'} lists no images" in warnings_of(scene_dir)
    (folder / "images.bin").unlink()
    scene = load_scene(scene_dir)
    assert (scene.images, scene.tracks, scene.intrinsics) == ((), None, model.intrinsics)
    np.testing.assert_array_equal(scene.points.xyz, model.points.xyz)
    assert f"{folder} has no images.bin or images.txt" in " ".join(texts(scene))


def test_missing_photographs_are_counted_and_the_first_is_named(scene_dir, model):
    path = scene_dir / "images" / model.images[1].name
    path = path.rename(path.with_name(path.name.upper()))
    assert f"({model.images[1].name}); IMAGE001.JPG " in warnings_of(scene_dir)
    path.unlink()
    assert "1 of 4 images is missing" in warnings_of(scene_dir)
    first = scene_dir / "images" / model.images[0].name
    PilImage.new("RGB", (64, 48)).save(first)
    assert "64 x 48" in warnings_of(scene_dir)
    first.write_bytes(b"no picture")
    assert "cannot be read" in warnings_of(scene_dir)
    (scene_dir / "images/left").rename(scene_dir / "left")
    assert load_scene(scene_dir).source.image_dir == scene_dir
    shutil.rmtree(scene_dir / "left")
    (scene_dir / "images").rmdir()
    assert "images folder is missing" in warnings_of(scene_dir)


def test_points_that_cannot_be_used_are_left_out_or_told(scene_dir, rng):
    rewrite_points(scene_dir, [[0, 0, 0], [-0.0, 0, 0], [1, 2, 3], [np.nan, 0, 0], [np.inf, 0, 0]])
    scene = load_scene(scene_dir)
    assert (len(scene.points), scene.left_out) == (2, LeftOut(2, 1))
    text = " ".join(texts(scene))
    assert "2 points are not finite" in text
    assert "1 point repeats" in text
    room, notes = (
        rng.uniform(-5, 5, (900, 3)),
        ("different frames", "1 point lies up to 1e+06 from the"),
    )
    for xyz, told in (
        (room + np.array([500_000, 5_000_000, 100]), [notes[0]]),
        (1000 * room + np.array([5000, 0, 0]), []),
        (np.concatenate([room, [[1e6] * 3]]), [notes[1]]),
        (np.concatenate([room, [[300.0] * 3]]), []),
    ):
        rewrite_points(scene_dir, xyz)
        text = warnings_of(scene_dir)
        assert [note for note in notes if note in text] == told


def test_scene_without_points_is_an_error_unless_allowed(scene_dir, scenes):
    rewrite_points(scene_dir, np.empty((0, 3)))
    with pytest.raises(SceneNotFoundError, match="sfm IMAGES --poses-from"):
        load_scene(scene_dir)
    (scene_dir / "sparse/0/points3D.bin").unlink()
    for path, num_images in ((scene_dir, 4), (scenes / "replica/room0", 20)):
        with pytest.raises(SceneNotFoundError, match="sfm IMAGES --poses-from"):
            load_scene(path)
        scene = load_scene(path, require_points=False)
        assert (len(scene.points), len(scene.images)) == (0, num_images)


@pytest.mark.parametrize(
    ("name", "error", "names"),
    [
        ("nowhere", SceneNotFoundError, "nowhere"),
        ("notes.txt", SceneFormatError, r"notes\.txt"),
        ("hall.laz", SceneFormatError, r"--cloud \S+hall\.laz"),
        ("a walk.mp4", SceneFormatError, r"splatseed sfm '.*/a walk\.mp4'"),
        ("empty", SceneNotFoundError, "empty"),
        ("half", SceneNotFoundError, r"transforms_test\.json"),
        (".", SceneNotFoundError, r": \S+scene$"),
        ("scene/images", SceneNotFoundError, r": \S+scene$"),
        ("scene/sparse/0/points3D.bin", SceneFormatError, r": \S+scene$"),
        ("scene/splatseed.json", SceneFormatError, r": \S+scene$"),
        ("scene/images/left/view.png", SceneFormatError, r": \S+scene$"),
        *((name, SceneNotFoundError, "a run of splatseed train") for name in ("run", "run/a.json")),
    ],
)
def test_what_is_no_scene_is_one_error(tmp_path, scene_dir, name, error, names):
    for folder in ("empty", "half", "run"):
        (tmp_path / folder).mkdir()
    for file in ("notes.txt", "hall.laz", "a walk.mp4", "half/transforms_test.json", "run/a.json"):
        (tmp_path / file).touch()
    (scene_dir / "images/left/view.png").touch()
    (scene_dir / "splatseed.json").write_text('{"command": "upsample"}')
    (tmp_path / "run/splatseed.json").write_text('{"command": "train"}')
    with pytest.raises(error, match=names):
        load_scene(tmp_path / name)


def test_a_point_beyond_all_distances_is_left_out(rng):
    xyz = rng.normal(size=(500, 3))
    xyz[0] = 1e30
    cloud = PointCloud(xyz, np.zeros((500, 3), np.uint8))
    clean = clean_scene(Scene(cloud))
    assert texts(clean) == ("1 point is beyond 1e15 and was left out.",)
    assert len(clean.points) == 499
    assert np.abs(upsample(cloud, "linear", num_points=800).xyz[500:]).max() < 10


@pytest.mark.parametrize(
    ("there", "lacking", "advice"),
    [
        (["rgb.txt", "depth.txt"], "groundtruth.txt", "has the poses"),
        (["rgb.txt", "KeyFrameTrajectory.txt"], "groundtruth.txt", "Rename KeyFrameTrajectory.txt"),
        (["groundtruth.txt"], "rgb.txt", "has the photographs"),
        (["transforms_test.json"], "transforms_train.json", "frames to train on"),
        (["cam_params.json"], "traj.txt", "has the poses"),
        (["odometry.csv"], "rgb.mp4", "Stray Scanner"),
        (["database.db"], "sparse/0", "splatseed sfm"),
    ],
)
def test_the_file_that_a_format_lacks_is_named(tmp_path, there, lacking, advice):
    for name in there:
        (tmp_path / name).touch()
    with pytest.raises(SceneNotFoundError) as error:
        load_scene(tmp_path)
    assert error.value.expected == f"{lacking} beside {tmp_path / there[0]}"
    assert advice in error.value.fix
