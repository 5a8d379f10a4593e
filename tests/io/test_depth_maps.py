"""Which file is the depth map of which image, and what its numbers mean."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.depthmap import DepthMap
from splatseed.errors import OutputError, ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io import find_depths, load_scene
from splatseed.io.depth_maps import (
    DESCRIPTION,
    LENSES,
    Undistortion,
    depth_folder,
    map_findings,
    write_lenses,
)
from splatseed.io.load import with_depths_in
from splatseed.io.staging import MANIFEST
from splatseed.lens import project_rays
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource

from ..findings import texts

LENS = Intrinsics(1, "PINHOLE", 40, 30, (35.0, 36.0, 20.0, 15.0))
BENT = Intrinsics(1, "OPENCV", 80, 60, (70.0, 72.0, 40.0, 30.0, -0.2, 0.0, 0.0, 0.0))
STRAIGHT = Intrinsics(1, "PINHOLE", 86, 62, (70.0, 72.0, 43.0, 31.0))
NO_POINTS = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))


def scene_of(*names: str, image_dir: Path | None = None) -> Scene:
    images = tuple(
        Image(name, i + 1, LENS, np.array([1.0, 0, 0, 0]), np.zeros(3))
        for i, name in enumerate(names)
    )
    source = SceneSource("colmap", Path(), Path(), image_dir=image_dir)
    return Scene(NO_POINTS, images, (LENS,), source=source)


def put(path: Path, value: int = 1) -> Path:
    """A small map of one value; an empty file, if neither of NumPy nor PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    if path.suffix == ".npy":
        np.save(path, np.full((3, 4), value))
    elif path.suffix == ".png":
        PilImage.new("I;16", (4, 3), value).save(path)
    return path


ORDER = [
    *("x/b.jpg.npy", "x/b.jpg.npz", "x/b.jpg.png", "x/b.jpg.geometric.bin"),
    *("x/b.jpg.photometric.bin", "x/b.npy", "x/b.exr", "x/b.pfm", "x/b.tiff", "x/b.tif", "x/b.png"),
    *("x/b_depth.npy", "x/b_depth.png"),
]


def test_the_first_of_several_candidates_is_taken(tmp_path):
    scene = scene_of("x/b.jpg")
    for name in ORDER:
        put(tmp_path / name)
    for name in ORDER:
        assert find_depths(scene, tmp_path).paths == {"x/b.jpg": tmp_path / name}
        (tmp_path / name).unlink()
    with pytest.raises(SceneNotFoundError, match=r"x/b\.jpg\.npy .*; found none"):
        find_depths(scene, tmp_path)


LEFT_RIGHT, DENSE = ["left/1.npy", "right/1.npy"], ["stereo/depth_maps/a.jpg.geometric.bin"]


@pytest.mark.parametrize("size", [(10, 7), (10, 8), (40, 30), (80, 59)])
def test_a_map_of_another_size_fits_its_image_within_a_pixel(size):
    (image,) = scene_of("a.png").images
    width, height = size
    camera = DepthMap(np.ones((height, width), np.float32)).camera(image.camera)
    assert camera.K[0] * 40 / width == pytest.approx(image.camera.K[0])
    assert camera.K[1] * 30 / height == pytest.approx(image.camera.K[1])
    with pytest.raises(SceneFormatError, match=f"aspect ratio.*found {width} x {height - 2}"):
        DepthMap(np.ones((height - 2, width), np.float32)).camera(image.camera)


@pytest.mark.parametrize(
    ("files", "names", "found"),
    [
        (["c.npy", "a.npy", "stranger.npy"], ["d.jpg", "c.jpg", "a.jpg"], ["a.npy", "c.npy"]),
        (["images/a_depth.png", "images/a.png"], ["a.png"], ["images/a_depth.png"]),
        (LEFT_RIGHT, ["x/left/1.jpg", "x/right/1.jpg"], LEFT_RIGHT),
        (["frame-3.depth.png", "frame-3.color.png"], ["frame-3.color.png"], ["frame-3.depth.png"]),
        (["1.npy", "left/1.npy"], ["left/1.jpg", "right/1.jpg"], ["left/1.npy"]),
        (["1.npy"], ["left/1.jpg", "right/1.jpg"], r"1\.npy for left/1\.jpg and for right/1\.jpg"),
        (DENSE, ["a.jpg"], DENSE),
        *((["a.npy", "x/y/other.npy"], [name], "found none") for name in ("../a.jpg", "/a.jpg")),
    ],
)
def test_which_files_belong_to_which_images(tmp_path, files, names, found):
    """Not photographs in their own folder, nor what lies out of it; folders may be missing."""
    for name in files:
        put(tmp_path / name)
    inside = tmp_path / {"images/a.png": "images", "x/y/other.npy": "x/y"}.get(files[-1], "")
    scene = scene_of(*names, image_dir=inside)
    if isinstance(found, str):
        with pytest.raises((SceneFormatError, SceneNotFoundError), match=found):
            find_depths(scene, inside)
    else:
        depths = find_depths(scene, inside)
        assert [depths.paths[name] for name in depths] == [tmp_path / name for name in found]
        assert len(depths) == len(found)


def test_images_without_a_map_are_named(tmp_path):
    put(tmp_path / "a.npy")
    depths = find_depths(scene_of("a.jpg", "c.jpg"), tmp_path)
    assert [name in depths for name in ("a.jpg", "c.jpg", None)] == [True, False, False]
    (tmp_path / "a.npy").unlink()
    for name, told in (("a.jpg", r"a\.npy"), ("c.jpg", r"a depth map of c\.jpg")):
        with pytest.raises(SceneNotFoundError, match=told):
            depths.read(name)


def test_confidence_is_undistorted_with_its_map(tmp_path):
    """Depth is 1 m more than the level, so that both must stay together."""
    levels = np.random.default_rng(0).integers(0, 3, (30, 40), np.uint8)
    PilImage.fromarray((1000 * (levels + 1.0)).astype(np.uint16)).save(tmp_path / "depth_7.png")
    PilImage.fromarray(levels).save(tmp_path / "conf_7.png")
    bent = Intrinsics(1, "OPENCV", 40, 30, (35.0, 36.0, 20.0, 15.0, -0.4, 0.0, 0.0, 0.0))
    maps = find_depths(scene_of("frame_00007.jpg"), tmp_path)
    plain = maps.read("frame_00007.jpg")
    np.testing.assert_array_equal(plain.confidence, levels)
    wide = replace(LENS, params=(20.0, 20.0, 20.0, 15.0))  # its corners lie outside of the map
    moved = replace(maps, lens=Undistortion({"frame_00007.jpg": bent}, {"frame_00007.jpg": wide}))
    depth = moved.read("frame_00007.jpg")
    known = np.isfinite(depth.values)
    assert 0.2 < known.mean() < 1
    np.testing.assert_array_equal(depth.values[known], depth.confidence[known] + 1)
    assert not depth.confidence[~known].any()
    assert not np.array_equal(depth.confidence, levels)


def test_a_confidence_per_pixel():
    with pytest.raises(ParameterError, match="per pixel of the depth map, 3 x 4; found 4 x 3"):
        DepthMap(np.ones((3, 4), np.float32), confidence=np.ones((4, 3), np.uint8))


@pytest.mark.parametrize("name", ["results", "."])
def test_rgbd_capture_by_the_frames_numbers(tmp_path, name):
    put(tmp_path / "room/results/depth000007.png", 500)
    put(tmp_path / "room/results/depth12.png", 1000)
    (tmp_path / "cam_params.json").write_text('{"camera": {"scale": 250.0}}')
    for frame in ("frame7.png", "frame000012.png"):  # photographs, of a scene elsewhere
        put(tmp_path / "room/results" / frame, 3)
    scene = scene_of("frame7.png", "frame000012.png")
    depths = find_depths(scene, tmp_path / "room" / name)
    assert [depths.read(im.name).values[0, 0] for im in scene.images] == [2, 4]


def test_description_beside_the_maps(tmp_path):
    put(tmp_path / "depths/a.png", 500)
    (tmp_path / "depths/depths.json").write_text('{"kind": "ray", "scale": 100}')
    scene, told = scene_of("a.jpg"), {"kind": "inverse", "scale": 50}
    for folder, options, expected in (
        (tmp_path, {}, ("ray", 5)),
        (tmp_path / "depths", {}, ("ray", 5)),
        (tmp_path, told, ("inverse", 10)),
    ):
        read = find_depths(scene, folder, **options).read("a.jpg")
        assert (read.kind, read.values[0, 0]) == expected


NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("stored", "options", "expected"),
    [
        (np.array([0.5, 1e-30, 9e8, 0, -0.0, -1]), {}, [0.5, 1e-30, 9e8, NAN, NAN, NAN]),
        (np.array([NAN, INF, -INF, 1e10, 1e9]), {}, [NAN] * 5),
        (np.array([0.0, -2, 3, NAN, -INF]), {"kind": "inverse"}, [0, -2, 3, NAN, NAN]),
        (np.uint16([0, 5, 65535]), {"kind": "inverse", "scale": 1}, [NAN, 5, 65535]),
        (np.uint16([0, 1500, 65535]), {}, [NAN, 1.5, NAN]),  # millimetres
        (np.uint8([0, 255, 100]), {}, [NAN, 0.255, 0.1]),
        (np.array([2000]), {}, [2]),
    ],
)
def test_what_numbers_mean_and_where_nothing_is_known(tmp_path, stored, options, expected):
    if stored.dtype.kind == "u":
        PilImage.fromarray(stored[None]).save(tmp_path / "a.png")
    else:
        np.save(tmp_path / "a.npy", stored[None])
    values = find_depths(scene_of("a.jpg"), tmp_path, **options).read("a.jpg").values
    np.testing.assert_array_equal(values, np.array([expected], np.float32))


WORDS = st.text(st.characters(categories=("L", "N"), include_characters=" -_.()"), min_size=1)
PARTS = WORDS.map(lambda word: word.strip(" .")).filter(lambda word: 0 < len(word.encode()) < 60)
NAMES = st.lists(PARTS, min_size=1, max_size=3).map(lambda parts: "/".join(parts) + ".jpg")
MAPS = hnp.arrays(
    np.float32,
    hnp.array_shapes(min_dims=2, max_dims=2, max_side=5),
    elements=st.just(np.float32(np.nan)) | st.floats(0.125, 1e6, width=32),
)


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    maps=st.dictionaries(NAMES, MAPS, min_size=1, max_size=4),
    kind=st.sampled_from(["z", "ray", "inverse"]),
)
def test_what_is_written_is_read(tmp_path_factory, maps, kind):
    path = tmp_path_factory.mktemp("maps") / "depths"
    tops = {name.split("/")[0] for name in maps}
    if any(f"{name}.npy" in tops for name in maps):  # a file where a folder must be
        return
    with depth_folder(path, kind, provenance={"model": "m"}) as writer:
        for name, values in maps.items():
            writer.write(name, values)
    told = json.loads((path / MANIFEST).read_text())
    files = sorted([DESCRIPTION, MANIFEST, *(f"{name}.npy" for name in maps)])
    assert told == {"model": "m", "command": "depth", "files": files}
    depths = find_depths(scene_of(*maps), path)
    assert list(depths) == sorted(maps)
    for name, values in maps.items():
        read = depths.read(name)
        assert read.kind == kind
        np.testing.assert_array_equal(read.values, values)


def test_a_name_out_of_the_folder_stays_inside(tmp_path):
    with depth_folder(tmp_path / "a" / "out", "z") as writer:
        writer.write("../images/f.jpg", np.ones((2, 2), np.float32))
        with pytest.raises(OutputError, match="two for"):
            writer.write("/images/f.jpg", np.ones((2, 2), np.float32))
        for shape in ((3,), (2, 2, 3), (0, 4)):
            with pytest.raises(SceneFormatError):
                writer.write("a.jpg", np.ones(shape, np.float32))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["out"]
    found = find_depths(scene_of("../images/f.jpg"), tmp_path / "a" / "out")
    assert list(found) == ["../images/f.jpg"]


# Of photographs that have been undistorted since


@pytest.fixture
def undistorted(tmp_path):
    """Undistorted photographs, the last of which had no distortion."""
    pose = (np.array([1.0, 0, 0, 0]), np.zeros(3))
    lenses = {"a.jpg": STRAIGHT, "b.jpg": replace(BENT.pinhole, camera_id=2)}
    images = tuple(Image(name, i, lens, *pose) for i, (name, lens) in enumerate(lenses.items()))
    write_lenses(tmp_path, {"a.jpg": BENT, "b.jpg": lenses["b.jpg"]})
    source = SceneSource("colmap", tmp_path, tmp_path / "points3D.bin")
    return Scene(PointCloud.empty(), images, source=source)


@pytest.mark.parametrize("factor", [1, 2])
def test_maps_of_the_photographs_of_before_are_undistorted(undistorted, tmp_path, factor):
    folder = tmp_path / "depth"
    folder.mkdir()
    height, width = 60 // factor, 80 // factor
    row, column = np.mgrid[:height, :width] * 1.0 + 0.5
    for name in ("a.npy", "b.npy"):
        np.save(folder / name, column)  # depth is the column, so that it says where it comes from
    if factor > 1:
        assert find_depths(undistorted, folder).lens is None  # perhaps a network's
        (tmp_path / "confidence").mkdir()
        PilImage.fromarray(np.full((height, width), 2, np.uint8)).save(
            tmp_path / "confidence/a.png"
        )
    maps = find_depths(undistorted, folder)
    depth = maps.read("a.jpg")
    assert (depth.width, depth.height) == (86 // factor, 62 // factor)
    camera = depth.camera(undistorted.images[0].camera)
    row, column = np.mgrid[: depth.height, : depth.width] + 0.5
    rays = np.stack([(column - camera.K[0, 2]) / camera.K[0, 0],
                     (row - camera.K[1, 2]) / camera.K[1, 1]], axis=-1)  # fmt: skip
    expected = project_rays(BENT, rays)[..., 0] / factor
    assert np.abs(depth.values - expected).max() <= 0.501
    assert np.abs(depth.values - column * width / depth.width).max() > 0.7  # as if not undistorted
    np.testing.assert_array_equal(maps.read("b.jpg").values[0], np.arange(width) + 0.5)
    assert any("before undistortion" in each for each in texts(with_depths_in(undistorted, folder)))


@pytest.mark.parametrize("shape", [(62, 86), (31, 43), (50, 50)])
def test_maps_of_the_undistorted_photographs_stay(undistorted, tmp_path, shape):
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth/a.npy", np.ones(shape))
    assert find_depths(undistorted, tmp_path / "depth").lens is None
    assert with_depths_in(undistorted, tmp_path / "depth").findings == ()


def test_damaged_lenses_are_named(undistorted, tmp_path):
    (tmp_path / "depth").mkdir()
    np.save(tmp_path / "depth/a.npy", np.ones((60, 80)))
    (tmp_path / LENSES).write_text('{"a.jpg": {"model": "OPENCV"}}')
    with pytest.raises(SceneFormatError, match="lenses by image name"):
        find_depths(undistorted, tmp_path / "depth")


def test_photographs_without_distortion_leave_no_file(tmp_path):
    write_lenses(tmp_path, {"a.jpg": STRAIGHT})
    assert not (tmp_path / LENSES).exists()


@pytest.mark.parametrize("place", ["depths", "sparse/0", "."])
def test_graphdecos_lines_make_inverse_depth(scene_dir, place):
    scene = load_scene(scene_dir)
    for image in scene.images:
        path = scene_dir / "depths" / f"{image.name.rpartition('.')[0]}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        PilImage.fromarray(np.array([[0, 1000], [2000, 65535]], np.uint16)).save(path)
    stems = [image.name.rpartition(".")[0] for image in scene.images]
    lines = {stem: {"scale": 2.0, "offset": 0.5} for stem in stems} | {stems[1]: {"scale": 0}}
    lines[stems[1]] |= {"offset": 0}  # a failed fit
    (scene_dir / place / "depth_params.json").write_text(json.dumps(lines))
    maps = find_depths(scene, scene_dir / "depths")
    first, second = (maps.read(image.name) for image in scene.images[:2])
    assert first.kind == second.kind == "inverse"
    expected = 2 * np.array([1000, 2000, 65535]) / 65536 + 0.5
    np.testing.assert_allclose(first.values[np.isfinite(first.values)], expected, rtol=1e-6)
    assert second.values[0, 1] == 1
    assert [each.kind for each in map_findings(maps)] == ["depth-kind"]
    named = find_depths(scene, scene_dir / "depths", kind="z")
    assert named.read(scene.images[0].name).values[0, 1] == 1
    (scene_dir / place / "depth_params.json").write_text("[1]")
    with pytest.raises(SceneFormatError, match=r"depth_params\.json"):
        find_depths(scene, scene_dir / "depths")
