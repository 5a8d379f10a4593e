"""Masks: which file belongs to which photograph, what counts, and what is refused."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed import upsample
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene, write_scene
from splatseed.io.load import with_own_depths
from splatseed.io.mask_files import masks_among
from splatseed.io.masks import mask_choice, masks_near, with_masks
from splatseed.photos.loading import load_views
from splatseed.pointcloud import PointCloud
from splatseed.sfm.photos import find_photos
from splatseed.synthetic import write_capture

from ..bent import bend
from ..findings import texts

BOX = np.s_[20:40, 30:60]


def paint(path, size=(96, 72), box=BOX, *, inside=0):
    """Write a mask of a box."""
    values = np.full(size[::-1], 255 - inside, np.uint8)
    values[box] = inside
    path.parent.mkdir(parents=True, exist_ok=True)
    PilImage.fromarray(values).save(path)
    return values > 0


@pytest.fixture
def scene_path(room_path, tmp_path):
    """A copy of the room, to which masks can be added."""
    return shutil.copytree(room_path, tmp_path / "scene")


def masks_of(scene, **options):
    return [view.mask for view in load_views(scene, scene.images, **options)]


@pytest.mark.parametrize("name", ["view_003.png.png", "view_003.png"])
def test_a_mask_belongs_to_the_photograph_of_its_name(scene_path, name):
    counts = paint(scene_path / "masks" / name)
    paint(scene_path / "masks" / "other.png")
    scene = load_scene(scene_path)
    masks = masks_of(scene)
    assert np.array_equal(masks[3], counts)
    assert [mask is None for mask in masks] == [i != 3 for i in range(9)]
    assert sum("other.png" in warning for warning in texts(scene)) == 1


def test_a_smaller_pixel_counts_only_if_all_of_its_pixels_count(scene_path):
    counts = paint(scene_path / "masks/view_000.png", box=np.s_[21:22, 30:33])
    mask = masks_of(load_scene(scene_path), data_factor=4)[0]
    assert np.array_equal(mask, counts.reshape(18, 4, 24, 4).all(axis=(1, 3)))
    assert np.count_nonzero(~mask) == 2


def test_transparent_pixels_do_not_count(scene_path):
    """From half of the full alpha on they show something, in their own colour."""
    path = scene_path / "images/view_000.png"
    with PilImage.open(path) as photograph:
        photograph.putalpha(PilImage.fromarray(np.full((72, 96), 250, np.uint8)))
        photograph.save(path)
        assert masks_of(load_scene(scene_path))[0] is None
        photograph.putpixel((5, 7), (1, 2, 3, 127))
        photograph.putpixel((6, 7), (1, 2, 3, 128))
        photograph.save(path)
    scene = load_scene(scene_path)
    (view,) = load_views(scene, scene.images[:1])
    assert np.argwhere(~view.mask).tolist() == [[7, 5]]
    assert view.photograph[7, 5:7].tolist() == [[0, 0, 0], [1, 2, 3]]
    assert np.array_equal(view.photograph, scene.images[0].read())
    (found,) = (each for each in scene.findings if each.kind == "transparent-pixels")
    assert "left out" in found.text


def cut_out(path, *, moving):
    """Make the photographs opaque in a box, which moves with each, with a soft edge."""
    for i, file in enumerate(sorted((path / "images").iterdir())):
        alpha = np.zeros((72, 96), np.uint8)
        first = 10 + 4 * i * moving
        alpha[10:60, first : first + 40] = 250
        alpha[9, first : first + 40] = 60
        with PilImage.open(file) as photograph:
            photograph.putalpha(PilImage.fromarray(alpha))
            photograph.save(file)


def test_transparent_pixels_around_an_object_that_is_cut_out_are_empty(scene_path, tmp_path):
    cut_out(scene_path, moving=True)
    scene = load_scene(scene_path)
    (found,) = (each for each in scene.findings if each.kind == "transparent-pixels")
    assert "empty space" in found.text
    (view,) = load_views(scene, scene.images[:1])
    straight = np.asarray(PilImage.open(scene.images[0].path))
    opaque = straight[..., 3] >= 128
    assert view.mask is None
    assert np.array_equal(view.surface, opaque)
    composited = straight[..., :3] * (straight[..., 3:] / 255.0)
    assert np.abs(view.photograph - composited).max() <= 1
    small = load_views(scene, scene.images[:1], data_factor=4)[0]
    assert np.array_equal(small.surface, opaque.reshape(18, 4, 24, 4).all(axis=(1, 3)))

    left_out, shown = with_masks(scene, "alpha"), with_masks(scene, "none")
    (masked,), (same,) = (load_views(each, each.images[:1]) for each in (left_out, shown))
    assert np.array_equal(masked.mask, opaque)
    assert np.array_equal(same.surface, view.surface)
    for i, each in enumerate((scene, left_out, shown)):
        again = load_scene(write_scene(each, tmp_path / f"out{i}").path)
        assert mask_choice(again) == (None, "alpha", "none")[i]
        assert again.images[0].shows_empty_space == (i != 1)


def test_the_same_transparent_border_in_all_photographs_is_masked(scene_path):
    cut_out(scene_path, moving=False)
    scene = load_scene(scene_path)
    (view,) = load_views(scene, scene.images[:1])
    assert view.empty is None
    assert view.mask.mean() == pytest.approx(50 * 40 / (72 * 96))


def test_cover_makes_no_seed_in_empty_pixels(scene_path):
    cut_out(scene_path, moving=True)
    scene = load_scene(scene_path)
    one = scene.replace(images=scene.images[:1])
    opaque = load_views(one, one.images)[0].surface
    seeds = upsample(one, "cover")
    uv = one.images[0].camera.project(seeds.xyz[seeds.num_original :])[0].astype(int)
    # A cell of 8 px needs half of its pixels.
    near = np.pad(opaque, 4).astype(int)
    assert len(uv)
    assert all(near[v : v + 9, u : u + 9].any() for u, v in uv)


def test_a_folder_none_and_inverted_can_be_chosen(scene_path, tmp_path):
    counts = paint(scene_path / "masks/view_000.png")
    other = paint(tmp_path / "other/view_000.png.png", box=np.s_[:9, :9])
    scene = load_scene(scene_path)
    assert masks_of(with_masks(scene, "none"))[0] is None
    assert np.array_equal(masks_of(with_masks(scene, "inverted"))[0], ~counts)
    assert np.array_equal(masks_of(with_masks(scene, str(tmp_path / "other")))[0], other)
    inverted = with_masks(scene, f"inverted:{tmp_path / 'other'}")
    assert np.array_equal(masks_of(inverted)[0], ~other)
    for choice in (str(tmp_path / "nowhere"), str(scene_path / "sparse")):
        with pytest.raises(SceneNotFoundError, match="masks of the scene's images"):
            with_masks(scene, choice)


def test_masks_that_leave_out_most_pixels_may_be_inverted(scene_path, tmp_path):
    """Many tools mark by 255 what is to be left out."""
    note = (
        "Masks leave out 91% of the pixels of their photographs: if 0 marks the pixels that count"
    )
    for i in range(9):
        paint(tmp_path / f"own/view_{i:03}.png")
        counted = paint(scene_path / f"masks/view_{i:03}.png", inside=255)
    assert 1 - counted.mean() == pytest.approx(0.91, abs=0.005)
    scene, of_sfm = load_scene(scene_path), masks_near(scene_path / "images")[1]
    assert [each for each in texts(scene) if note in each] == [f"{note}, use `masks='inverted'`."]
    assert f"{note}, invert them." in map(str, of_sfm)  # sfm has no such option
    for choice in ("inverted", "none", str(tmp_path / "own")):
        assert not any(note in warning for warning in texts(with_masks(scene, choice)))


def test_what_cannot_be_a_mask_is_named(scene_path):
    path = scene_path / "masks/view_000.png"
    paint(path, size=(48, 40), box=np.s_[:5, :5])
    with pytest.raises(SceneFormatError, match=r"view_000.png.* 96 x 72; found 48 x 40"):
        masks_of(load_scene(scene_path))
    paint(path, box=np.s_[:, :])
    with pytest.raises(SceneFormatError, match=r"view_000\.png.*found none"):
        masks_of(load_scene(scene_path))
    path.write_bytes(b"no image")
    with pytest.raises(SceneFormatError, match=r"view_000.png to be an image"):
        masks_of(load_scene(scene_path))


@pytest.mark.parametrize("folder", ["elsewhere", "masks"])
def test_transforms_name_masks(scene_path, tmp_path, folder):
    """Their ``mask_path`` is read, whatever it names, and a new file has one for each frame."""
    scene = load_scene(scene_path)
    for i in range(9):
        paint(tmp_path / f"other/view_{i:03}.png.png")
    chosen = with_masks(scene, str(tmp_path / "other"))
    write_scene(chosen, tmp_path / "out", format="transforms")
    frames = json.loads((tmp_path / "out/transforms.json").read_text("utf-8"))["frames"]
    assert [frame["mask_path"] for frame in frames] == [
        f"masks/{image.name}.png" for image in scene.images
    ]
    (tmp_path / "out/masks").rename(tmp_path / "out/old")
    for i, frame in enumerate(frames):
        old, frame["mask_path"] = frame["mask_path"], f"{folder}/{i}.png"
        (tmp_path / "out" / folder).mkdir(exist_ok=True)
        (tmp_path / "out" / old.replace("masks/", "old/")).rename(
            tmp_path / "out" / frame["mask_path"]
        )
    text = json.loads((tmp_path / "out/transforms.json").read_text("utf-8"))
    (tmp_path / "out/transforms.json").write_text(json.dumps({**text, "frames": frames}), "utf-8")
    again = load_scene(tmp_path / "out")
    assert all(np.array_equal(m, masks_of(chosen)[0]) for m in masks_of(again))
    for layout in ("colmap", "transforms"):
        write_scene(again, tmp_path / f"as_{layout}", format=layout)
        assert np.array_equal(
            masks_of(load_scene(tmp_path / f"as_{layout}"))[4], masks_of(chosen)[4]
        )


def test_inverted_masks_are_written_as_others_read_them(scene_path, tmp_path):
    counts = paint(scene_path / "masks/view_000.png")
    write_scene(with_masks(load_scene(scene_path), "inverted"), tmp_path / "out")
    masks = masks_of(load_scene(tmp_path / "out"))
    assert np.array_equal(masks[0], ~counts)
    assert len(list((tmp_path / "out/masks").iterdir())) == 9  # of all, or COLMAP fails


def test_depth_is_lifted_where_pixels_count(scene_path):
    counts = paint(scene_path / "masks/view_000.png", box=np.s_[:, :50])
    scene = with_own_depths(load_scene(scene_path))
    scene = scene.replace(images=scene.images[:1])
    points = upsample(scene, "depth", num_points=len(scene.points) + 200)
    uv = scene.images[0].camera.project(points.xyz[len(scene.points) :])[0].astype(int)
    assert counts[uv[:, 1], uv[:, 0]].all()


@pytest.mark.usefixtures("pycolmap_here")
def test_undistortion_carries_masks_along(room_of, tmp_path):
    """By our own and by pycolmap's, the box covers the same part of the photographs."""
    pytest.importorskip("pycolmap", reason="pycolmap undistorts")
    from splatseed.sfm import undistort

    path = write_capture(bend(room_of(9, 96, 72).capture), tmp_path / "bent")
    photograph = np.asarray(PilImage.open(path / "images/view_000.png")).copy()
    photograph[BOX] = (255, 0, 255)
    PilImage.fromarray(photograph).save(path / "images/view_000.png")
    paint(path / "masks/view_000.png")
    scene = load_scene(path)
    undistort(scene, tmp_path / "flat")
    flat = load_scene(tmp_path / "flat")
    for view in (
        load_views(scene, scene.images[:1], undistort=True)[0],
        load_views(flat, flat.images[:1])[0],
    ):
        painted = (view.photograph == (255, 0, 255)).all(axis=2)
        assert not (painted & view.mask).any()
        assert np.count_nonzero(~view.mask) < 1.35 * np.count_nonzero(painted) + 400


@pytest.mark.parametrize(
    "name",
    [
        *("masks/{}.PNG", "masks/{}.jpg", "Masks/{}.png", "mask/{}.png.png", "images/masks/{}.png"),
        *("mask/{}.mask.png", "masks/{}_mask.png", "masks/{}.png.mask.png", "masks/VIEW_003.png"),
        *("masks/{}.tif", "masks/{}.webp", "masks/{}.gif"),
        *("images/{}.mask.png", "images/{}_mask.png", "images/{}.png.mask.png"),
    ],
)
def test_masks_of_other_tools_are_found_and_written_as_colmaps(scene_path, tmp_path, name):
    counts = paint(scene_path / name.format("view_003"))
    scene = load_scene(scene_path)
    assert scene.masks.files.keys() == {"view_003.png"}
    (mask,) = [each for each in masks_of(scene) if each is not None]
    if not name.endswith((".jpg", ".webp")):  # which blur edges
        assert np.array_equal(mask, counts)
    assert np.count_nonzero(mask != counts) < 40
    out = write_scene(scene, tmp_path / "out", format="colmap").path
    assert np.array_equal(masks_of(load_scene(out))[3], mask)


def test_files_beside_photographs_need_no_masks(scene_path):
    folder = (scene_path / "images").rename(scene_path / "camera")
    (scene_path / "images").mkdir()
    folder.rename(scene_path / "images/camera")
    for path in list((scene_path / "images/camera").iterdir()):
        path.with_suffix(".xmp").touch()
        paint(scene_path / "masks" / path.name)
    (scene_path / "images/notes.txt").touch()
    masks, found = masks_near(scene_path / "images")
    assert masks.files.keys() == {f"camera/view_{i:03}.png" for i in range(9)}
    assert [str(each) for each in found] == [
        f"9 photographs with a mask in {scene_path / 'masks'}."
    ]


def test_hidden_files_are_no_masks(scene_path):
    for i in range(9):
        paint(scene_path / f"masks/view_{i:03}.png")
        for folder in ("masks", "images"):
            (scene_path / folder / f"._view_{i:03}.png").write_bytes(b"Mac OS X")
    assert load_scene(scene_path).findings == ()
    assert len(masks_near(scene_path / "images")[0].files) == 9


def test_masks_of_a_format_that_is_not_read_are_noted(scene_path):
    paint(scene_path / "masks/view_003.png")
    for name in ("view_003.npy", "view_004.png.npy", "view_005.npy", "notes.txt"):
        (scene_path / "masks" / name).write_bytes(b"")
    reason = "are of a format that is not read: save masks as PNG."
    note = f"2 masks, such as view_004.png.npy, {reason}"
    scene = load_scene(scene_path)
    assert [warning for warning in texts(scene) if "not read" in warning] == [note]
    assert note in texts(with_masks(scene, str(scene_path / "masks")))
    (scene_path / "masks/view_003.png").unlink()
    assert f"3 masks, such as view_003.npy, {reason}" in texts(load_scene(scene_path))


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("segmentation/view_003.png", "inverted:{}/segmentation"),
        ("dynamic_masks/view_003.png", "{}/dynamic_masks"),
        ("images/dynamic_mask_view_003.png", "inverted:{}/images"),
        ("sky_masks/view_003.png", "{}/sky_masks"),
    ],
)
def test_masks_of_unknown_meaning_are_mentioned_and_can_be_named(scene_path, name, way):
    paint(scene_path / name)
    scene = load_scene(scene_path)
    way = way.format(scene_path)
    assert not scene.masks.files
    assert sum(f"`masks={way!r}`" in each for each in texts(scene)) == 1
    assert with_masks(scene, way).masks.files.keys() == {"view_003.png"}


def test_masks_that_fit_no_photograph_are_counted_and_so_are_photographs_without(scene_path):
    paint(scene_path / "masks/IMG_1.png")
    said, folder = " ".join(texts(load_scene(scene_path))), scene_path / "masks"
    assert f"1 mask in {folder} belongs to no image of the scene, such as IMG_1" in said
    paint(scene_path / "mask/view_001.png")
    scene = load_scene(scene_path)  # the folder that fits
    assert scene.masks.files.keys() == {"view_001.png"}
    assert "8 images of 9 with masks" in " ".join(texts(scene))


def test_masks_of_another_size_are_resized(scene_path):
    path = scene_path / "masks/view_000.png"
    paint(path, size=(48, 36), box=np.s_[10:20, 15:30])
    scene = load_scene(scene_path)
    assert "resized" in " ".join(texts(scene))
    counts = np.ones((72, 96), bool)
    counts[20:40, 30:60] = False
    assert np.array_equal(masks_of(scene)[0], counts)
    paint(path, size=(144, 108), box=np.s_[31:61, 45:90])
    counts[20] = counts[40, 30:60] = True
    counts[20, 30:60] = counts[40, 30:60] = False
    assert np.array_equal(masks_of(load_scene(scene_path))[0], counts)


def test_a_transparent_mask_masks(scene_path):
    values = np.full((72, 96, 4), 255, np.uint8)
    values[BOX][..., 3] = 0
    (scene_path / "masks").mkdir()
    PilImage.fromarray(values).save(scene_path / "masks/view_000.png")
    assert np.array_equal(masks_of(load_scene(scene_path))[0], values[..., 3] > 0)


def test_masks_are_no_photographs(scene_path):
    for name in ("view_001_mask.png", "view_002.png.mask.png", "masks/view_003.png"):
        counts = paint(scene_path / "images" / name)
        rgb = np.repeat(counts[..., None], 3, axis=2).astype(np.uint8) * 255
        PilImage.fromarray(rgb).save(scene_path / "images" / name)
    pytest.importorskip("pycolmap")
    photos, left_out = find_photos(scene_path / "images")
    assert len(photos) == 9
    assert [len(names) for names in left_out.values()] == [3]
    masks, _ = masks_near(scene_path / "images")
    assert masks.files.keys() == {"view_003.png"}  # a folder goes first
    names = ["a.jpg", "b_mask.jpg", "a_mask.png", "x/masks/a.png"]
    assert masks_among(names) == {"a_mask.png", "x/masks/a.png"}
    assert masks_among(["mask/a.png", "mask/b.png"]) == set()


@pytest.mark.parametrize("layout", ["auto", "colmap", "transforms"])
@pytest.mark.parametrize("kind", ["blender", "named", "folder", "beside"])
def test_no_masks_are_written_of_a_scene_without_them(kind, layout, tmp_path, rng):
    """Neither a trainer nor splatseed would use them, whatever lies near the photographs."""
    root, parts = tmp_path / "scene", ("train", "test") if kind == "blender" else ("images",)
    for part in parts:
        frames = []
        for i in range(3):
            photograph = root / part / f"{i}.png"
            photograph.parent.mkdir(parents=True, exist_ok=True)
            PilImage.new("RGBA", (96, 72)).save(photograph)
            place = f"{part}/{i}_mask.png" if kind == "beside" else f"masks/{i}.png"
            paint(root / (f"masks/{part}/{i}.png" if kind == "blender" else place))
            pose = np.eye(4)
            pose[:3, 3] = rng.normal(size=3)
            frame = {"file_path": f"{part}/{i}.png", "transform_matrix": pose.tolist()}
            frames.append(frame | ({"mask_path": place} if kind == "named" else {}))
        name = f"transforms_{part}.json" if kind == "blender" else "transforms.json"
        (root / name).write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames}))
    points = PointCloud(rng.normal(size=(9, 3)), np.zeros((9, 3), np.uint8))
    scene = load_scene(root, require_points=False).with_points(points)
    assert len(scene.masks.files) == 3 * len(parts)
    out = write_scene(with_masks(scene, "none"), tmp_path / "out", format=layout).path
    assert not (out / "masks").exists()
    assert layout == "colmap" or "mask_path" not in (out / "transforms.json").read_text()
    again = load_scene(out)
    assert again.masks is None
    assert mask_choice(again) == "none"
    kept = load_scene(write_scene(scene, tmp_path / "kept", format=layout).path)
    assert len(kept.masks.files) == 3 * len(parts)
