"""Views: the box filter, intrinsics, the cache, the split, undistortion, and what is refused."""

from __future__ import annotations

import dataclasses
import shutil

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene, write_scene
from splatseed.io.photograph_checks import ROUNDING, _off, fits
from splatseed.lens import project_rays
from splatseed.photos.loading import load_photograph, load_split, load_views
from splatseed.photos.sizes import at_file_size
from splatseed.photos.undistortion import undistort
from splatseed.photos.view import camera_views
from splatseed.seeding.budget import points_within
from splatseed.seeding.photo_methods import frames_of
from splatseed.tracks import NO_POINT, Observations

from ..findings import texts


@pytest.fixture
def picture(tmp_path, rng):
    path = tmp_path / "a.png"
    PilImage.fromarray(rng.integers(0, 256, (23, 37, 3), np.uint8)).save(path)
    return path


@pytest.mark.parametrize("factor", [1, 2, 3, 5])
def test_a_smaller_photograph_is_the_mean_over_blocks(picture, factor):
    full = np.asarray(PilImage.open(picture), np.float64)
    pixels = load_photograph(picture, factor)
    height, width = 23 // factor, 37 // factor
    blocks = full[: height * factor, : width * factor]
    means = blocks.reshape(height, factor, width, factor, 3).mean(axis=(1, 3))
    assert pixels.shape == (height, width, 3)
    assert np.abs(pixels - means).max() < 0.6  # Pillow rounds in fixed point


def test_the_cache_is_used_until_the_photograph_changes(picture, tmp_path):
    cache = tmp_path / "cache"
    first = load_photograph(picture, 2, cache)
    (kept,) = cache.iterdir()
    whole = kept.read_bytes()
    np.savez(kept, photograph=255 - first)
    assert np.array_equal(load_photograph(picture, 2, cache), 255 - first)
    flipped = bytearray(whole)
    flipped[whole.index(first.tobytes()) + 5] ^= 1
    for damaged in (b"damaged", whole[:200], bytes(flipped)):
        kept.write_bytes(damaged)
        assert np.array_equal(load_photograph(picture, 2, cache), first)
        assert kept.read_bytes() == whole
    PilImage.new("RGB", (37, 23), (9, 9, 9)).save(picture)
    assert (load_photograph(picture, 2, cache) == 9).all()


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_point_stays_on_its_pixel(room, factor):
    """A point's pixel in the view is its pixel in the camera record over the factor."""
    image, xyz = room.images[0], room.points.xyz[:50]
    (view,) = load_views(room, [image], data_factor=factor)
    uv, depth = image.camera.project(xyz)
    small = view.camera.project(xyz)[0]
    assert np.allclose(small[depth > 0], uv[depth > 0] / factor, atol=1e-6)


@pytest.fixture
def copied(room_path, tmp_path):
    shutil.copytree(room_path, tmp_path / "copy")
    return load_scene(tmp_path / "copy")


def test_files_resized_beforehand_scale_the_intrinsics(copied):
    whole, root = copied.images[0], copied.source.root
    for each in whole.path.parent.iterdir():
        PilImage.open(each).resize((48, 36)).save(each)
    scene = load_scene(root)
    (view,) = load_views(scene, scene.images[:1])
    for image in scene.images:
        assert image.intrinsics == image.lens.resized(96, 72) == whole.intrinsics
        assert np.allclose(image.K[:2], whole.intrinsics.K[:2] / 2)
    assert np.array_equal(view.K, scene.images[0].K)
    assert points_within(scene, "1rho") == 48 * 36
    assert {(each.width, each.height) for each in frames_of(scene)} == {(48, 36)}
    small = at_file_size(scene.images)
    assert {image.intrinsics for image in small} == {scene.images[0].lens}
    assert np.allclose(small[1].observations.xy, scene.images[1].observations.xy / 2)
    PilImage.open(whole.path).resize((48, 48)).save(whole.path)
    cropped = load_scene(root)
    assert cropped.images[0].lens == whole.intrinsics
    with pytest.raises(SceneFormatError, match="found 48 x 48: cropped, or stretched"):
        load_views(cropped, cropped.images[:1])


def test_resized_files_are_written_with_their_cameras_as_they_were(copied, tmp_path):
    root = copied.source.root
    for each in (root / "images").iterdir():
        PilImage.open(each).resize((48, 36)).save(each)
    write_scene(load_scene(root), tmp_path / "out")
    for name in ("cameras.bin", "images.bin", "points3D.bin"):
        written, given = (path / "sparse" / "0" / name for path in (tmp_path / "out", root))
        assert written.read_bytes() == given.read_bytes()


RECORD = 96, 72
COPIES = [(48, 36), (192, 144), (37, 28), (95, 72), (96, 71), (97, 72), (120, 91)]


@pytest.mark.parametrize("name", CAMERA_MODELS)
def test_a_point_keeps_its_relative_position_in_resized_copies(name, room, tmp_path):
    """At any size, also of slightly other shape, and whether views or the scene are resized."""
    model = CAMERA_MODELS[name]
    focal, terms = (80.0, 84.0)[: model.num_focal], model.num_params - model.num_focal - 2
    lens = Intrinsics(1, name, *RECORD, (*focal, 47.0, 37.0, *(0.02, -0.01, 0.005, 0.01)[:terms])
        + (0.001,) * max(0, terms - 4))  # fmt: skip
    (tmp_path / "images").mkdir()
    source = dataclasses.replace(room.source, image_dir=tmp_path / "images")
    images = []
    for i, size in enumerate(COPIES):
        PilImage.new("RGB", size).save(tmp_path / "images" / f"{i}.png")
        seen = Observations(np.array([[48.0, 18.0]]), np.array([NO_POINT]))
        old = room.images[0]
        images.append(dataclasses.replace(old, name=f"{i}.png", intrinsics=lens, observations=seen))
    scene = room.replace(images=tuple(images), intrinsics=(lens,), source=source)
    assert [(image.lens.width, image.lens.height) for image in scene.images] == COPIES
    sized = scene.replace(images=at_file_size(scene.images), intrinsics=())
    assert [image.intrinsics for image in sized.images] == [
        dataclasses.replace(image.lens, camera_id=i + 1) for i, image in enumerate(scene.images)
    ]
    xy = np.array([[0.3, -0.2], [-0.25, 0.1], [0.0, 0.0]])
    for image, size in zip(sized.images, COPIES, strict=True):
        place = project_rays(image.intrinsics, xy) / size
        assert np.allclose(place, project_rays(lens, xy) / RECORD, atol=1e-12)
        assert np.allclose(image.observations.xy / size, [[0.5, 0.25]])
    for factor in (1, 3):
        one, other = (
            load_views(s, s.images, data_factor=factor, undistort=True) for s in (scene, sized)
        )
        frames = camera_views(scene.images, factor)
        for a, b, c, size in zip(one, other, frames, COPIES, strict=True):
            assert np.array_equal(a.K, b.K)
            assert np.array_equal(a.K, c.K)
            shown = np.array([a.width, a.height]) * factor
            assert (
                (a.width, a.height) == (c.width, c.height) == (size[0] // factor, size[1] // factor)
            )
            assert np.allclose(
                factor * a.K[:2] / np.array(size)[:, None], lens.K[:2] / np.array(RECORD)[:, None]
            )
            assert (shown <= size).all()


@pytest.mark.parametrize(
    ("size", "orientation", "says"),
    [
        ((72, 96), 6, "found 72 x 96: stored rotated, with EXIF orientation 6; 1 more of 9"),
        ((36, 48), 8, "found 36 x 48: stored rotated, with EXIF orientation 8"),
        ((72, 96), 1, r"found 72 x 96"),
        ((96, 60), 1, "found 96 x 60: cropped, or stretched"),
        ((48, 36), 6, ""),
        ((96, 71), 3, ""),
    ],
)
def test_each_photograph_is_checked_against_its_own_record(size, orientation, says, copied):
    exif = PilImage.Exif()
    exif[0x0112] = orientation
    images = sorted(copied.images, key=lambda image: image.name)[:9]
    for image in images[3:5]:
        PilImage.new("RGB", size).save(copied.source.image_dir / image.name, exif=exif)
    copied = load_scene(copied.source.root)
    images = sorted(copied.images, key=lambda image: image.name)[:9]
    told = " ".join(texts(copied))
    if not says:
        assert "not fit" not in told
        assert [view.photograph.shape[1::-1] for view in load_views(copied, images)][3] == size
        return
    assert f"{images[3].name} has {size[0]} x {size[1]} pixels, its camera" in told
    with pytest.raises(SceneFormatError, match=says) as caught:
        load_views(copied, images)
    assert images[3].name in caught.value.expected
    assert caught.value.fix in told
    assert all(image.lens is image.intrinsics for image in images)


def test_a_stretched_shape_gives_one_warning():
    def warned(record, *sizes):
        lens = Intrinsics(1, "PINHOLE", *record, (900.0, 900.0, 500.0, 500.0))
        return [_off(lens, size) > ROUNDING for size in sizes if fits(lens, size)]

    assert warned((1920, 1088), (1920, 1080), (960, 544), (961, 544), (480, 272)) == [True] + 3 * [
        False
    ]
    assert warned((1616, 1203), (808, 601), (808, 602), (404, 300), (16, 12)) == 4 * [False]
    assert warned((100, 99), (99, 100), (100, 99), (50, 50)) == [False, False]  # turned: no copy


def bent(room, k):
    lens = Intrinsics(1, "SIMPLE_RADIAL", 96, 72, (80.0, 48.0, 36.0, k))
    return dataclasses.replace(room.images[0], intrinsics=lens)


def test_unreadable_photographs_are_named(room, tmp_path):
    bad = tmp_path / "bad.png"
    bad.write_bytes(b"no image")
    for error, says, read, *words in (
        (SceneFormatError, "undistort", load_views, room, [bent(room, 0.1)]),
        (SceneFormatError, "to be an image", load_photograph, bad),
        (SceneNotFoundError, "no such file", load_photograph, tmp_path / "none.png"),
        (ParameterError, "never enlarged", load_photograph, bad, 0),
        (SceneNotFoundError, "at least two images", load_split, room.replace(images=())),
    ):
        with pytest.raises(error, match=says):
            read(*words)
    with pytest.raises(SceneFormatError, match="`data_factor`"):
        load_views(room, room.images[:1], data_factor=9, min_side=11)
    assert load_views(room, [bent(room, 0.0)])


WIDTH, HEIGHT = 96, 72
LENSES = [
    Intrinsics(1, "OPENCV", WIDTH, HEIGHT, (80.0, 84.0, 47.0, 37.0, 0.3, 0.05, 0.02, -0.01)),
    Intrinsics(1, "OPENCV_FISHEYE", WIDTH, HEIGHT, (60.0, 60.0, 48.0, 36.0, 0.6, -0.01, 0.0, 0.0)),
]


def rays_of(K, column, row):
    return np.stack([(column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]], axis=-1)


COLUMN, ROW = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)


def painting(xy):
    """A smooth picture of the plane at depth 1."""
    x, y = xy[..., 0], xy[..., 1]
    waves = [np.sin(5 * x + 2 * y), np.cos(4 * y - x), np.sin(3 * x) * np.cos(3 * y)]
    return 127.5 + 120 * np.stack(waves, axis=-1)


def photograph(lens):
    """What the lens sees of the painting: rays of its pixels by fixed-point iteration."""
    goal, xy = np.stack([COLUMN, ROW], axis=-1), rays_of(lens.K, COLUMN, ROW)
    for _ in range(200):
        xy = xy + 0.5 * (goal - project_rays(lens, xy)) / lens.K[[0, 1], [0, 1]]
    assert np.abs(project_rays(lens, xy) - goal).max() < 1e-6
    return np.rint(painting(xy)).astype(np.uint8)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_colours_are_interpolated_between_four_pixels(lens, rng):
    """A literal loop over pixels."""
    source = rng.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    pixels, known = undistort(source, lens, lens.K)
    padded = np.pad(source.astype(float), ((1, 1), (1, 1), (0, 0)), mode="edge")
    for i, j in np.ndindex(HEIGHT, WIDTH):
        u, v = project_rays(lens, rays_of(lens.K, np.array(j + 0.5), np.array(i + 0.5)))
        if not (0 <= u <= WIDTH and 0 <= v <= HEIGHT):
            assert not known[i, j]
            assert not pixels[i, j].any()
            continue
        x, y = min(int(u + 0.5), WIDTH), min(int(v + 0.5), HEIGHT)
        a, b = u + 0.5 - x, v + 0.5 - y
        upper = (1 - a) * padded[y, x] + a * padded[y, x + 1]
        lower = (1 - a) * padded[y + 1, x] + a * padded[y + 1, x + 1]
        assert np.abs(pixels[i, j] - ((1 - b) * upper + b * lower)).max() <= 0.5 + 1e-9
    assert 0 < known.sum() < known.size


def test_pixels_beyond_a_fold_are_masked():
    lens = Intrinsics(1, "SIMPLE_RADIAL", WIDTH, HEIGHT, (30.0, 48.0, 36.0, -0.3))
    white = np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    pixels, known = undistort(white, lens, lens.K)
    rays = rays_of(lens.K, COLUMN, ROW)
    uv = project_rays(lens, rays)
    assert np.all((uv > 0) & (uv < [WIDTH, HEIGHT]), axis=-1).all()  # all would show something
    distance = np.linalg.norm(rays, axis=-1)
    fold = np.sqrt(1 / 0.9)
    assert known[distance < 0.99 * fold].all()
    assert not known[distance > 1.01 * fold].any()
    assert np.array_equal(pixels[..., 0] == 255, known)


def test_views_are_undistorted_on_request(copied):
    """One photograph is of a lens, and a copy of half the size."""
    bent = LENSES[0]
    image, other = dataclasses.replace(copied.images[0], intrinsics=bent), copied.images[1]
    half = PilImage.fromarray(photograph(bent)).reduce(2)
    half.save(copied.source.image_dir / image.name)
    lens, straight = load_views(copied, [image, other], undistort=True)
    assert lens.mask.shape == lens.photograph.shape[:2] == (HEIGHT // 2, WIDTH // 2)
    assert np.allclose(lens.K[:2], bent.K[:2] / 2)
    column, row = np.meshgrid(np.arange(WIDTH // 2) + 0.5, np.arange(HEIGHT // 2) + 0.5)
    error = np.abs(lens.photograph - painting(rays_of(lens.K, column, row))).max(axis=-1)
    assert np.mean(error[lens.mask] < 5) > 0.95
    assert straight.mask is None
    (alone,) = load_views(copied, [other])
    assert np.array_equal(alone.photograph, straight.photograph)
