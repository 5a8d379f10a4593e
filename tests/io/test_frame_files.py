"""What a transforms.json names is found, also where it was written on another computer."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError
from splatseed.io import load_scene, write_scene

from ..findings import texts

LENS = {"w": 8, "h": 6, "fl_x": 7.0}


def shoot(root, *names, mode="RGB", value=9):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        PilImage.new(mode, (8, 6), value).save(root / name)


def frame(i, **fields):
    pose = np.eye(4)
    pose[0, 3] = i
    return {"transform_matrix": pose.tolist(), **fields}


def write(root, names, name="transforms.json", **root_fields):
    frames = [
        frame(i, **({"file_path": n} if isinstance(n, str) else n)) for i, n in enumerate(names)
    ]
    root.mkdir(parents=True, exist_ok=True)
    (root / name).write_text(json.dumps({**LENS, **root_fields, "frames": frames}))
    return root


def load(root):
    return load_scene(root, require_points=False)


def files_of(scene):
    return [
        (scene.source.image_dir / image.name).relative_to(scene.source.root).as_posix()
        for image in scene.images
    ]


@pytest.mark.parametrize(
    ("named", "there", "num_notes"),
    [
        ("images\\{}.png", "images/{}.png", False),
        (".\\images\\{}.png", "images/{}.png", False),
        ("./images/{}", "images/{}.JPG", False),
        ("images/{}", "images/{}.tif", False),
        ("images/my%20{}.png", "images/my {}.png", False),
        ("images/{}.depth", "images/{}.depth.png", False),
        ("images/IMG{}.jpg", "images/IMG{}.JPG", True),
        ("images/img{}.jpg", "images/IMG{}.JPG", True),
        ("C:\\data\\room\\images\\{}.png", "images/{}.png", True),
        ("C:/data/room/{}.png", "images/{}.png", True),
        ("\\\\server\\share\\images\\{}.png", "images/{}.png", True),
        ("/data/room/images/a/{}.png", "images/a/{}.png", True),
        ("../room/images/{}.png", "images/{}.png", True),
        ("{}.png", "images/{}.png", True),
    ],
)
def test_photographs_are_found_and_named_in_the_output(tmp_path, named, there, num_notes):
    root = tmp_path / "scene"
    shoot(root, *(there.format(i) for i in range(3)))
    if "depth" not in there:
        shoot(root, "images/0.depth.png", mode="I;16")
    scene = load(write(root, [named.format(i) for i in range(3)]))
    assert files_of(scene) == [there.format(i) for i in range(3)]
    notes = [text for text in texts(scene) if "transforms.json" in text]
    assert len(notes) == num_notes == len(texts(scene))
    out = write_scene(scene, tmp_path / "out", require_points=False).path
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    again = load(out)
    assert files_of(again) == files_of(scene)
    assert again.has_photographs
    assert all("\\" not in each["file_path"] for each in frames)


def test_what_is_missing_is_no_other_frames_photograph(tmp_path):
    root = tmp_path / "scene"
    shoot(root, "left/0.png", "images/0.png", "0.png")
    names = ["left/0.png", "right/0.png", "0.png"]
    assert files_of(load(write(root, names))) == names
    no_size = write(tmp_path / "b", [], **dict.fromkeys(LENS), camera_angle_x=1.0)
    shoot(no_size, "images/0.png")
    write(no_size, ["images/0.png", "images/1.png"], w=None, h=None)
    scene = load(no_size)
    assert files_of(scene) == ["images/0.png"]
    assert "1 of 2 frames" in " ".join(texts(scene))


def test_repeated_frames_are_left_out_unless_they_disagree(tmp_path):
    root = tmp_path / "scene"
    shoot(root, "images/0.png", "images/1.png")
    same = [{"file_path": n, **frame(0)} for n in ("images/0.png", "./images/0.png")]
    write(root, [*same, "images/1.png"])
    scene = load(root)
    assert files_of(scene) == ["images/0.png", "images/1.png"]
    assert "1 frame of transforms.json" in " ".join(texts(scene))
    write(root, ["images/0.png", "images\\0.png"])
    with pytest.raises(SceneFormatError, match=r"frame 2 .*image of its own"):
        load(root)


def test_test_frames_are_the_split_and_bad_ones_are_left_out(tmp_path):
    """As in ScanNet++, whose photographs lie beside the file's folder."""
    root = tmp_path / "dslr/nerfstudio"
    shoot(tmp_path / "dslr", *(f"resized_images/{i}.JPG" for i in range(5)))
    shoot(tmp_path / "dslr", "resized_anon_masks/1.png", mode="L")
    names = [{"file_path": "0.JPG", "is_bad": False}, {"file_path": "1.JPG", "mask_path": "1.png"}]
    names.append({"file_path": "2.JPG", "is_bad": True})
    tests = [frame(3, file_path="3.JPG"), frame(4, file_path="4.JPG")]
    write(root, names, test_frames=tests)
    scene = load(root)
    assert [[i.name for i in part] for part in scene.split()] == [
        ["0.JPG", "1.JPG"],
        ["3.JPG", "4.JPG"],
    ]
    assert scene.masks.files == {"1.JPG": tmp_path / "dslr/resized_anon_masks/1.png"}
    assert "1 frame marked is_bad" in " ".join(texts(scene))
    again = load(write_scene(scene, tmp_path / "out", require_points=False).path)
    assert again.split() != again.replace(listed=None).split()
    assert [len(part) for part in again.split()] == [2, 2]
    # COLMAP's layout, which is written, too, knows masks by their names: by others than here.
    assert not (tmp_path / "out/masks").exists()  # the mask masks nothing
    assert "mask_path" not in (tmp_path / "out/transforms.json").read_text()
    with PilImage.open(tmp_path / "dslr/resized_anon_masks/1.png") as mask:
        mask.paste(0, (0, 0, 3, 6))
        mask.save(tmp_path / "dslr/resized_anon_masks/1.png")
    again = load(write_scene(scene, tmp_path / "masked", require_points=False).path)
    counts = {name: file for name, file in again.masks.files.items() if name == "1.JPG"}
    assert counts == {"1.JPG": tmp_path / "masked/masks/1.JPG.png"}
    assert np.array(PilImage.open(counts["1.JPG"])).any(axis=0).tolist() == [False] * 3 + [True] * 5
    for i in (3, 4):  # as where photographs are kept back
        (tmp_path / f"dslr/resized_images/{i}.JPG").unlink()
    scene = load(root)
    assert (len(scene.images), scene.listed) == (2, None)
    assert "2 test frames" in " ".join(texts(scene))


@pytest.mark.parametrize("with_file", [True, False])
def test_blenders_files_without_test_pictures(tmp_path, with_file):
    root = tmp_path / "scene"
    shoot(root, *(f"train/{i:04}.png" for i in range(9)))
    sized = dict.fromkeys(LENS) | {"camera_angle_x": 1.0}
    write(root, [f"train/{i:04}" for i in range(9)], "transforms_train.json", **sized)
    if with_file:
        write(root, [f"test/{i:04}" for i in range(5)], "transforms_test.json", **sized)
    scene = load(root)
    assert [len(part) for part in scene.split()] == [7, 2]
    assert scene.listed is None
    assert sum("transforms_test.json" in text for text in texts(scene)) == 1


@pytest.mark.parametrize(
    ("key", "fields", "stored", "expected"),
    [
        ("depth_path", {"integer_depth_scale": 10 / 65535}, 13107, 2.0),
        ("depth_file_path", {}, 2000, 2.0),
        ("depth_file_path", {"depth_unit_scale_factor": 0.01}, 200, 2.0),
        ("depth_path", {}, 2000, 2.0),
    ],
)
def test_depth_maps_have_the_unit_of_the_file(tmp_path, key, fields, stored, expected):
    root = tmp_path / "scene"
    shoot(root, "images/0.png", "images/1.png")
    shoot(root, "sensor/d_0.png", mode="I;16", value=stored)
    write(root, [{"file_path": "images/0", key: "sensor\\d_0.png"}, "images/1"], **fields)
    scene = load(root)
    assert list(scene.depths) == ["0.png"]
    assert scene.findings == ()
    depth = scene.depths.read("0.png")
    np.testing.assert_allclose(depth.values, expected, rtol=1e-4)
    again = load(write_scene(scene, tmp_path / "out", require_points=False).path)
    np.testing.assert_array_equal(again.depths.read("0.png").values, depth.values)
    write(root, [{"file_path": "images/0", key: "sensor/d_0.png"}], integer_depth_scale=-1)
    with pytest.raises(SceneFormatError, match="integer_depth_scale"):
        load(root)


def test_a_depth_scale_per_frame_is_one_for_all(tmp_path):
    root, scales = tmp_path / "scene", (0.001, 0.001)
    shoot(root, "images/0.png", "images/1.png")
    shoot(root, "images/0.depth.png", "images/1.depth.png", mode="I;16", value=1500)

    def write_scales(scales):
        named = [
            {"file_path": f"images/{i}", "depth_path": f"images/{i}.depth.png"} for i in (0, 1)
        ]
        own = [{"integer_depth_scale": scale} if scale else {} for scale in scales]
        frames = [{**frame, **fields} for frame, fields in zip(named, own, strict=True)]
        write(root, frames, integer_depth_scale=1 / 65535)

    write_scales(scales)
    assert load(root).depths.read("1.png").values == pytest.approx(1.5)
    write_scales((0.001, None))
    with pytest.raises(SceneFormatError, match="one integer_depth_scale for all frames"):
        load(root)


def test_depth_maps_that_are_named_but_missing(tmp_path):
    """NeRFCapture's offline mode names depth maps that it does not write."""
    root = tmp_path / "scene"
    shoot(root, "images/0.png", "images/1.png")
    frames = [{"file_path": f"images/{i}", "depth_path": f"images/{i}.depth.png"} for i in (0, 1)]
    write(root, frames, depth_integer_scale=1.0)
    scene = load(root)
    assert scene.depths is None
    assert texts(scene) == (
        "2 depth maps named in transforms.json cannot be found, such as images/0.depth.png.",
    )


def test_spectacular_ais_folder(tmp_path):
    """Depth lies among the photographs, and a model without true tracks beside."""
    root = tmp_path / "scene"
    shoot(root, "images/frame_00001.jpg", "images/frame_00002.jpg")
    shoot(root, "images/depth_00001.png", "images/depth_00002.png", mode="I;16", value=2500)
    frames = [
        {
            "file_path": f"./images/frame_0000{i}.jpg",
            "depth_file_path": f"./images/depth_0000{i}.png",
        }
        for i in (1, 2)
    ]
    write(root, frames, ply_file_path="./sparse_pc.ply", orientation_override="none")
    names = [f"property float {axis}" for axis in "xyz"]
    names += [f"property uint8 {color}" for color in ("red", "green", "blue")]
    header = ["ply", "format ascii 1.0", "element vertex 1", *names, "end_header"]
    (root / "sparse_pc.ply").write_text("\n".join([*header, "2.5 -2.75 -0.0625 103 91 71", ""]))
    (root / "colmap/sparse/0").mkdir(parents=True)
    for name in ("cameras", "images", "points3D"):
        (root / f"colmap/sparse/0/{name}.txt").write_text("not read")
    scene = load(root)
    assert [image.name for image in scene.images] == ["frame_00001.jpg", "frame_00002.jpg"]
    np.testing.assert_array_equal(scene.points.xyz, [[2.5, -2.75, -0.0625]])
    np.testing.assert_array_equal(scene.points.rgb, [[103, 91, 71]])
    assert list(scene.depths) == ["frame_00001.jpg", "frame_00002.jpg"]
    assert scene.depths.read("frame_00002.jpg").values == pytest.approx(2.5)


def test_relocated_masks_and_maps_are_of_one_frame(tmp_path):
    """Of a rig's cameras, files of one name were once in several folders."""
    root, kinds = tmp_path / "scene", (("mask_path", "masks"), ("depth_file_path", "depth"))
    names = []
    for camera in ("left", "right"):
        fields = {key: f"D:\\rig\\{camera}\\{folder}\\0.png" for key, folder in kinds}
        names.append({"file_path": f"{camera}/0.png", **fields})
        shoot(root, names[-1]["file_path"])
    shoot(root, "masks/0.png", "depth/0.png", mode="L")
    scene = load(write(root, names))
    assert not scene.masks.files
    assert scene.depths is None
    for what in ("2 masks", "2 depth maps"):
        assert f"{what} named in transforms.json cannot be found" in " ".join(texts(scene))
    out = write_scene(scene, tmp_path / "out", format="transforms", require_points=False).path
    named = json.loads((out / "transforms.json").read_text())["frames"]
    assert [each["mask_path"] for each in named] == [each["mask_path"] for each in names]
    shared = [{**each, "mask_path": "D:\\rig\\masks\\0.png"} for each in names]
    assert len(load(write(root, shared)).masks.files) == 2  # one mask for all, such as a bonnet's


def test_masks_that_are_named_are_found_or_told(tmp_path):
    root = tmp_path / "scene"
    shoot(root, "images/0.png", "images/1.png")
    shoot(root, "masks/0.png", mode="L")
    names = [
        {"file_path": f"images/{i}.png", "mask_path": f"D:\\x\\masks\\{i}.png"} for i in (0, 1)
    ]
    scene = load(write(root, names))
    assert scene.masks.files == {"0.png": root / "masks/0.png"}
    assert "1 mask named in transforms.json" in " ".join(texts(scene))


@pytest.mark.parametrize(("named", "there"), [("images", "images_4"), ("images_2", "images")])
def test_a_folder_of_another_size_stands_in_for_an_absent_one(tmp_path, named, there):
    frames = [
        {"file_path": f"{named}/{i}.png", "transform_matrix": np.eye(4).tolist()} for i in range(3)
    ]
    (tmp_path / named).mkdir()  # empty
    (tmp_path / there).mkdir()
    for i in range(3):
        PilImage.new("RGB", (8, 6), (i, 0, 0)).save(tmp_path / there / f"{i}.png")
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"fl_x": 40, "w": 32, "h": 24, "frames": frames}))
    scene = load_scene(tmp_path, require_points=False)
    assert scene.source.image_dir == tmp_path / there
    first = scene.images[0]
    assert (first.name, first.lens.width, first.K[0, 0]) == ("0.png", 8, 10)
    assert "moved-photographs" in {each.kind for each in scene.findings}
    (tmp_path / named / "0.png").touch()
    assert load_scene(tmp_path, require_points=False).source.image_dir == tmp_path / named
