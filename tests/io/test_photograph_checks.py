"""Images that cannot be used: the others are, and still train or test as before."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io import colmap, load_scene, write_scene
from splatseed.io.photograph_checks import photograph_findings, with_photographs
from splatseed.photos.visibility import find_visibility

from ..findings import texts


def names(images):
    return [image.name for image in images]


def parts(scene):
    return [names(part) for part in scene.split(2)]


def without(parts_of_all, gone):
    return [[name for name in part if name not in gone] for part in parts_of_all]


def test_missing_photographs_leave_the_others_in_their_part(scene_dir):
    whole = load_scene(scene_dir)
    assert with_photographs(whole) is whole
    gone = names(whole.images)[:2]
    for name in gone:
        (scene_dir / "images" / name).unlink()
    scene = load_scene(scene_dir)
    assert len(scene.images) == len(whole.images)  # as the model is written again
    noted = [text for text in texts(scene) if "missing" in text]
    assert len(noted) == 1
    assert (
        f"2 of 4 images are missing in {scene_dir / 'images'}, and left out ({', '.join(gone)})"
        in noted[0]
    )
    used = with_photographs(scene)
    assert names(used.images) == names(whole.images)[2:]
    assert parts(used) == without(parts(whole), gone)
    write_scene(used, scene_dir.with_name("written"))
    assert parts(load_scene(scene_dir.with_name("written"))) == parts(used)
    (scene_dir / "images" / names(used.images)[0]).unlink()
    with pytest.raises(
        SceneNotFoundError, match=r"at least half of the scene's 4 .* found 1; missing"
    ):
        with_photographs(scene)


@pytest.mark.parametrize("named", [True, False])
def test_a_photograph_in_another_folder_is_named(scene_dir, named):
    images = list(load_scene(scene_dir).images)
    (scene_dir / "images" / "left").rename(scene_dir / "images" / "cam0")
    if named:  # then these files are other images'
        images += [replace(each, name=each.name.replace("left", "cam0")) for each in images]
    found = photograph_findings(images, scene_dir / "images", scene_dir)[0]
    hint = "cam0/image000.jpg exists, but names must match exactly"
    assert (hint in found.text) is not named


@pytest.mark.parametrize("form", ["bin", "txt"])
@pytest.mark.parametrize(
    "broken", ["nan pose", "infinite pose", "zero quaternion", "nan camera", "no focal length"]
)
def test_images_of_nan_are_left_out_and_the_others_are_used(broken, form, scene_dir, model):
    folder, whole = scene_dir / "sparse/0", load_scene(scene_dir)
    images, cameras = list(model.images), list(model.intrinsics)
    if "camera" in broken or "focal" in broken:
        bad = (np.nan if "nan" in broken else 0.0, *cameras[1].params[1:])
        cameras[1] = replace(cameras[1], params=bad)
        gone = [image.name for image in images if image.intrinsics.camera_id == 9]
    else:
        pose = {"translation": np.full(3, np.nan if "nan" in broken else np.inf)}
        images[1] = replace(images[1], **({"quat": np.zeros(4)} if "zero" in broken else pose))
        gone = [images[1].name]
    colmap.write_cameras(folder / "cameras.bin", cameras)
    colmap.write_images(folder / "images.bin", images)
    if form == "txt":
        as_text(folder, cameras, images)
    scene = load_scene(scene_dir)
    assert names(scene.images) == [n for n in names(whole.images) if n not in gone]
    assert scene.absent == tuple(gone)
    assert parts(scene) == without(parts(whole), gone)
    (note,) = (text for text in texts(scene) if "not finite" in text)
    assert f"{len(gone)} of 4 images" in note
    assert gone[0] in note
    assert len(find_visibility(scene).of(scene.images[0]))
    write_scene(scene, scene_dir.with_name("written"))
    again = load_scene(scene_dir.with_name("written"))
    assert parts(again) == parts(scene)
    assert not any("not finite" in text for text in texts(again))


def as_text(folder, cameras, images):
    lines = [
        f"{c.camera_id} {c.model} {c.width} {c.height} {' '.join(map(str, c.params))}"
        for c in cameras
    ]
    (folder / "cameras.txt").write_text("\n".join(lines))
    rows = []
    for image in images:
        pose = " ".join(map(str, (*image.quat.tolist(), *image.translation.tolist())))
        rows.append(f"{image.image_id} {pose} {image.intrinsics.camera_id} {image.name}")
        seen = zip(
            image.observations.xy.tolist(), image.observations.point_ids.tolist(), strict=True
        )
        rows.append(" ".join(f"{x} {y} {i}" for (x, y), i in seen))
    (folder / "images.txt").write_text("\n".join(rows) + "\n")
    for name in ("cameras", "images"):
        (folder / f"{name}.bin").unlink()


def test_a_model_whose_poses_are_mostly_nan_is_an_error(scene_dir, model):
    lost = [replace(image, translation=np.full(3, np.nan)) for image in model.images[:3]]
    colmap.write_images(scene_dir / "sparse/0/images.bin", [*lost, model.images[3]])
    with pytest.raises(SceneFormatError, match=r"a finite pose of image 'left/image000\.jpg'"):
        load_scene(scene_dir)


@pytest.mark.parametrize(
    "change", [{"transform_matrix": "nan"}, {"transform_matrix": "zeros"}, {"fl_x": float("inf")}]
)
def test_frames_of_nan_are_left_out(change, scene_dir):
    whole = load_scene(scene_dir)
    pinholes = [replace(image, intrinsics=whole.intrinsics[0]) for image in whole.images]
    write_scene(whole.replace(images=pinholes),
        scene_dir.with_name("json"), format="transforms")  # fmt: skip
    path = scene_dir.with_name("json") / "transforms.json"
    content = json.loads(path.read_text())
    values = {"nan": np.full((4, 4), np.nan).tolist(), "zeros": np.zeros((4, 4)).tolist()}
    content["frames"][1] |= {key: values.get(value, value) for key, value in change.items()}
    path.write_text(json.dumps(content))
    scene = load_scene(path.parent)
    assert parts(scene) == without(parts(whole), [whole.images[1].name])
    assert sum("1 of 4 images is left out" in text for text in texts(scene)) == 1
    write_scene(scene, scene_dir.with_name("again"))
    assert parts(load_scene(scene_dir.with_name("again"))) == parts(scene)


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0, 1 / 640])
def test_intrinsics_of_another_size_are_noted(scale, model, scene_dir):
    """A transforms.json may state no size, and its photographs may be resized; 1 / 640: shares."""
    lens = model.images[0].intrinsics
    scaled = replace(lens, params=tuple(scale * each for each in lens.params))
    path = scene_dir / "sparse/0/cameras.bin"
    colmap.write_cameras(path, [scaled, model.images[1].intrinsics])
    noted = [w for w in texts(load_scene(scene_dir)) if "not in pixels of this size" in w]
    assert len(noted) == (scale != 1)
    assert all("2 of 4 images" in note and model.images[0].name in note for note in noted)
