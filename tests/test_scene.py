"""Scene: the split, the poses, and which points keep their tracks."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from PIL import Image as Photograph

from splatseed.camera import Camera, Intrinsics
from splatseed.depth.stereo import StereoMap
from splatseed.depthmap import DepthMap
from splatseed.errors import ParameterError, SceneNotFoundError, UnknownNameError
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Masks, Scene, SceneSource
from splatseed.similarity import Similarity
from splatseed.tracks import NO_POINT, Observations, Tracks

INTRINSICS = Intrinsics(1, "PINHOLE", 64, 48, (50.0, 50.0, 32.0, 24.0))


def _image(name, quat=(1.0, 0, 0, 0), translation=(0.0, 0, 0)):
    return Image(name, 1, INTRINSICS, np.array(quat), np.array(translation))


@pytest.fixture
def scene(rng):
    xyz = rng.normal(size=(5, 3))
    xyz[2] = np.nan
    lengths = np.array([2, 3, 2, 4, 2])
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    seen = np.zeros(offsets[-1], np.uint32)
    tracks = Tracks(np.arange(5), xyz, np.ones(5), offsets, seen, seen)
    return Scene(PointCloud(xyz, np.zeros((5, 3), np.uint8)), tracks=tracks)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 20])
def test_the_split_takes_every_eighth_name(count, rng):
    names = [f"{i:03d}.jpg" for i in range(count)]
    images = tuple(_image(names[i]) for i in rng.permutation(count))
    train, test = Scene(PointCloud.empty(), images).split()
    assert [image.name for image in test] == names[::8]
    assert sorted(image.name for image in train + test) == names
    assert [image.name for image in train] == sorted(image.name for image in train)


def test_tracks_stay_with_the_points_they_belong_to(scene):
    more = PointCloud.concatenate(scene.points, scene.points)  # also those that are NaN
    assert scene.replace(points=more).tracks is scene.tracks
    recolored = scene.points.replace(rgb=np.full((5, 3), 9, np.uint8))
    assert scene.replace(points=recolored).tracks is scene.tracks


def test_tracks_do_not_pass_to_other_points(scene):
    points = scene.points
    for other in (
        points.select(np.arange(5)[::-1]),
        PointCloud.concatenate(points.select([4]), points.select(slice(4))),
        points.replace(xyz=points.xyz + 1),
        points.select(slice(0)),
    ):
        changed = scene.replace(points=other)
        assert changed.tracks is None
        assert scene.tracks is not None


def test_originals_that_stay_keep_their_tracks(scene):
    keep = np.array([True, False, True, True, False])
    more = PointCloud(np.full((3, 3), 7.5, np.float32), np.zeros((3, 3), np.uint8), np.full(3, 4))
    changed = scene.replace(points=PointCloud.concatenate(scene.points.select(keep), more))
    assert changed.tracks.lengths.tolist() == [2, 2, 4]
    np.testing.assert_array_equal(changed.tracks.point_ids, scene.tracks.point_ids[keep])
    np.testing.assert_array_equal(changed.tracks.xyz, scene.tracks.xyz[keep])


def test_tracks_follow_rows_through_selections(scene):
    """Not positions: of two originals at one place each has its own track."""
    twins = scene.points.replace(xyz=scene.points.xyz[[0, 1, 1, 1, 4]])
    scene = scene.replace(points=twins, tracks=scene.tracks)
    kept = PointCloud.concatenate(scene.points.select(slice(2)), scene.points.select([3]))
    more = kept.with_added(np.ones((2, 3)), np.zeros((2, 3), np.uint8))
    changed = scene.with_points(more)
    np.testing.assert_array_equal(changed.tracks.point_ids, [0, 1, 3])
    again = changed.with_points(changed.points.select([0, 2]))  # rows count in the new scene
    np.testing.assert_array_equal(again.tracks.point_ids, [0, 3])
    other = PointCloud(scene.points.xyz[[3, 1]], scene.points.rgb[[3, 1]])  # from nowhere
    assert scene.with_points(other).tracks is None


def test_features_of_points_that_went_belong_to_none(scene):
    seen = Observations(np.zeros((4, 2)), np.array([0, 1, NO_POINT, 4]))
    scene = scene.replace(images=(dataclasses.replace(_image("a"), observations=seen),))
    kept = scene.replace(points=scene.points.select([0, 2, 4]))
    ids = kept.images[0].observations.point_ids
    np.testing.assert_array_equal(ids, [0, NO_POINT, NO_POINT, 4])
    others = scene.replace(points=scene.points.replace(xyz=scene.points.xyz + 1))
    assert (others.images[0].observations.point_ids == NO_POINT).all()


@pytest.mark.parametrize(("count", "tests"), [(3, 0), (11, 0), (12, 2), (17, 3)])
def test_of_few_images_none_tests_by_default(count, tests):
    images = tuple(_image(f"{i:02}.jpg") for i in reversed(range(count)))
    scene = Scene(PointCloud.empty(), images)
    train, test = scene.split(scene.default_test_every)
    assert (len(train), len(test)) == (count - tests, tests)
    assert len(scene.split()[1]) == 1 + (count - 1) // 8
    every = scene.split(0)
    assert ([image.name for image in every[0]], every[1]) == (sorted(i.name for i in images), ())


def _faces(*panoramas, width=100, focal=42.0):
    """Photographs as ``undistort`` cuts them: 100 degrees wide, whose tangent of half is 1.19."""
    lens = Intrinsics(2, "PINHOLE", width, 100, (focal, focal, width / 2, 50.0))
    return [
        dataclasses.replace(_image(f"{folder}{face}_{name}"), intrinsics=lens)
        for folder, name in panoramas
        for face in ("front", "right", "back", "left", "up", "down")
    ]


def test_all_faces_of_a_panorama_test_or_none():
    walk = [("", "a.jpg"), ("", "b.jpg"), ("c/", "a.jpg"), ("c/", "up_b.jpg")]
    scene = Scene(PointCloud.empty(), (*_faces(*walk), _image("b.jpeg")))
    assert (scene.num_viewpoints, scene.default_test_every) == (5, 0)
    tested = {image.name for image in _faces(walk[0], walk[2])}  # 1st and 4th of 5
    gone = ["back_a.jpg", "c/front_a.jpg", "b.jpeg", *(im.name for im in _faces(walk[1]))]
    for some in (scene, scene.without(gone)):
        there = {image.name for image in some.images}
        assert {image.name for image in some.split(3)[1]} == there & tested
    many = Scene(PointCloud.empty(), tuple(_faces(*(("", f"{k:02}.jpg") for k in range(12)))))
    assert many.default_test_every == 8
    assert {im.name.partition("_")[2] for im in many.split()[1]} == {"00.jpg", "08.jpg"}
    assert [len(part) for part in many.split()] == [60, 12]


@pytest.mark.parametrize("lens", [{"width": 120}, {"focal": 50.0}])
def test_other_photographs_with_names_of_faces_are_counted_one_by_one(lens):
    scene = Scene(PointCloud.empty(), tuple(_faces(("", "1.jpg"), ("", "2.jpg"), **lens)))
    assert (scene.num_viewpoints, scene.default_test_every) == (12, 8)
    assert [image.name for image in scene.split()[1]] == ["back_1.jpg", "right_1.jpg"]


@pytest.mark.parametrize("test_every", [-8, 1, 2.5])
def test_a_split_that_leaves_nothing_to_train_on_is_refused(test_every):
    with pytest.raises(ParameterError, match="test_every as a whole number of 2 or more"):
        Scene(PointCloud.empty(), (_image("a.jpg"),)).split(test_every)


def test_records_share_no_array_that_their_maker_can_change():
    def arrays(kind, **given):
        record = kind(**given)
        return [(given[name], getattr(record, name)) for name in given]

    rows, ids = np.ones((4, 3)), np.arange(5)
    pose, seen = np.eye(4), np.zeros(4, np.uint32)
    made = [
        *arrays(Observations, xy=rows[:, :2], point_ids=ids),
        *arrays(Tracks, point_ids=ids, xyz=rows, errors=rows[0], offsets=ids, image_ids=seen,
                point2d_idx=seen),
        *arrays(Camera, K=np.eye(3), cam_from_world=pose, width=4, height=4)[:2],
        *arrays(Similarity, rotation=np.eye(3), translation=rows[0], scale=1.0)[:2],
        *arrays(DepthMap, values=rows),
    ]  # fmt: skip
    image = dataclasses.replace(_image("a.jpg"), quat=pose[0])
    for given, kept in [*made, (pose[0], image.quat)]:
        assert given.flags.writeable
        assert not kept.flags.writeable
        assert not np.shares_memory(given, kept)
        assert (given == kept).all()


def test_reprs_are_short():
    many = Observations(np.zeros((5000, 2)), np.full(5000, NO_POINT))
    image = dataclasses.replace(_image("a.jpg"), observations=many)
    scene = Scene(PointCloud(np.zeros((5000, 3)), np.zeros((5000, 3), np.uint8)), (image,) * 500)
    assert len(repr(scene).splitlines()) <= 5
    for shown in ("500", "64 x 48", "5,000"):
        assert shown in repr(scene)
    assert len(repr(image)) < 100


def test_images_by_name(room, room_path):
    image = room[room.images[3].name]
    assert image is room.images[3]
    assert image.path == room_path / "images" / image.name
    np.testing.assert_array_equal(image.K, image.intrinsics.K)
    np.testing.assert_array_equal(image.cam_from_world, image.camera.cam_from_world)
    assert (image.K.shape, image.cam_from_world.shape) == ((3, 3), (4, 4))
    with Photograph.open(image.path) as file:
        np.testing.assert_array_equal(image.read(), np.asarray(file.convert("RGB")))
    assert image.name in room
    assert "no.jpg" not in room
    with pytest.raises(TypeError):
        iter(room)


def test_a_scene_made_in_memory_has_no_files():
    scene = Scene(PointCloud.empty(), (_image("a.jpg"),))
    source, image = scene.source, scene.images[0]
    assert (source.format, source.root, source.again, source.inputs) == ("memory", None, None, ())
    assert (scene.has_photographs, image.has_photograph, image.size) == (False, False, None)
    assert image.lens is image.intrinsics
    with pytest.raises(SceneNotFoundError, match="a folder that holds the photograph a"):
        image.read()


def test_images_follow_their_scene(room):
    moved = room.replace(source=dataclasses.replace(room.source, image_dir=room.source.root))
    assert not moved.has_photographs
    assert room.replace(source=SceneSource()).images[0].folder is None
    masks = Masks({}, alpha=False)
    assert room.replace(masks=masks).images[-1].masks is masks


def test_an_unknown_name_lists_near_ones():
    scene = Scene(PointCloud.empty(), (_image("left/DSC01.JPG"), _image("left/DSC02.JPG")))
    for name, near in (("dsc01.jpg", "left/DSC01.JPG"), ("left/DSC2.JPG", "left/DSC02.JPG")):
        with pytest.raises(KeyError) as caught:
            scene[name]
        assert near in caught.value.fix
    for name in ("zebra", 0):
        with pytest.raises(UnknownNameError, match=r"scene\.images"):
            scene[name]


def test_an_image_without_a_folder_has_no_path():
    with pytest.raises(FileNotFoundError, match=r"a\.jpg"):
        _image("a.jpg").read()


def test_own_points_and_maps_go_into_a_copy(room):
    more = room.points.with_added(np.ones((2, 3)), np.full((2, 3), 7, np.uint8))
    changed = room.with_points(more)
    assert (changed.points, changed.tracks) == (more, room.tracks)
    name = room.images[0].name
    depths = room.with_depths({name: np.ones((72, 96))}).depths
    assert (list(depths), room.depths) == ([name], None)


def test_maps_in_memory_are_a_scenes_depths():
    """As stereo returns them, or by name; anything else is refused at once."""
    scene = Scene(PointCloud.empty(), (_image("a.jpg"),))
    depth = np.array([[2.0, np.nan], [0.0, 3.0]], np.float32)
    more = (
        np.zeros((2, 2, 3)),
        np.ones((2, 2)),
        (),
        np.zeros((2, 2), np.uint8),
        np.zeros((2, 2, 3), np.uint8),
    )
    stereo = StereoMap("a.jpg", scene.images[0].camera, depth, *more)
    for given in ((stereo,), [stereo], {"a.jpg": depth}, {"a.jpg": DepthMap(depth)}):
        depths = scene.replace(depths=given).depths
        np.testing.assert_array_equal(depths.read("a.jpg").values[:, 1], depth[:, 1])
        assert list(depths) == ["a.jpg"]
        assert scene.replace(depths=depths).depths is depths
        with pytest.raises(SceneNotFoundError):
            depths.read("b.jpg")
    for wrong in (depth, "maps", [depth], {"a.jpg": "text"}, {"a.jpg": depth[0]}):
        with pytest.raises(ParameterError, match="depth maps by image name"):
            scene.replace(depths=wrong)
    bent = Intrinsics(1, "SIMPLE_RADIAL", 64, 48, (50.0, 32.0, 24.0, 0.1))
    scene = scene.replace(images=(dataclasses.replace(scene.images[0], intrinsics=bent),))
    with pytest.raises(ParameterError, match="without lens distortion"):
        scene.replace(depths=(stereo,))
