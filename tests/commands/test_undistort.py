"""``splatseed undistort``: pinhole cameras, the same points, and a scene that can be trained."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import map_coordinates

pytest.importorskip("pycolmap", reason="needs pycolmap")

from splatseed.errors import SceneFormatError
from splatseed.io import load_scene, write_scene
from splatseed.io.colmap import write_images
from splatseed.io.photograph import lens_findings
from splatseed.io.seeds import saw_all_photographs, was_upsampled
from splatseed.lens import project_rays, unproject_pixels
from splatseed.photos.loading import load_views, refuse_distortion
from splatseed.sfm import undistort
from splatseed.synthetic import write_capture

from ..bent import bend
from ..findings import texts
from ..wide_png import png16

pytestmark = pytest.mark.usefixtures("pycolmap_here")


@pytest.fixture(scope="module")
def distorted(room_of, tmp_path_factory):
    """The room through a lens with distortion."""
    capture = bend(room_of(12, 96, 72).capture)
    path = write_capture(capture, tmp_path_factory.mktemp("bent") / "scene")
    names = [image.name for image in capture.scene.images]
    (path / "test_list.txt").write_text("\n".join(names[:2]))
    return path


@pytest.mark.parametrize("how", ["absolute", "above", "within"])
def test_a_name_that_leads_out_is_refused(how, distorted, tmp_path, splatseed):
    """pycolmap would write the undistorted photograph over the one that the user has there."""
    path = shutil.copytree(distorted, tmp_path / "scene", symlinks=False)
    scene = load_scene(path)
    mine = shutil.copy(path / "images" / scene.images[0].name, tmp_path / "mine.png")
    names = {"absolute": str(mine), "above": "../../mine.png", "within": "../images/../mine.png"}
    images = (dataclasses.replace(scene.images[0], name=names[how]), *scene.images[1:])
    write_images(path / "sparse" / "0" / "images.bin", images)
    before = {each: each.read_bytes() for each in tmp_path.rglob("*") if each.is_file()}
    run = splatseed("undistort", path, "-o", tmp_path / "a" / "straight")
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert names[how] in run.err
    assert {each: each.read_bytes() for each in tmp_path.rglob("*") if each.is_file()} == before


def test_a_distorted_scene_becomes_one_of_pinholes(distorted, tmp_path, splatseed):
    path, out = distorted, tmp_path / "straight"
    before = load_scene(path)
    with pytest.raises(SceneFormatError, match="splatseed undistort"):
        refuse_distortion(before.images[0])
    run = splatseed("undistort", path, "-o", out)
    assert run.code == 0, run
    assert f"splatseed upsample {out}" in run.out
    assert f"Its 12 depth maps are not in the output: name them to upsample by --depth {path}" in (
        run.err
    )
    after = load_scene(out)
    assert {lens.model for lens in after.intrinsics} == {"PINHOLE"}
    assert {image.name for image in after.images} == {image.name for image in before.images}
    assert (after.listed.train, after.listed.test) == (before.listed.train, before.listed.test)
    np.testing.assert_array_equal(after.points.xyz, before.points.xyz)
    assert len(load_views(after, after.images)) == len(before.images)
    assert not any("missing" in each for each in texts(after))
    for folder in (out, write_scene(after, tmp_path / "again").path):  # for depth maps
        lenses = json.loads((folder / "distorted.json").read_text())
        bent = before.images[0].intrinsics
        assert lenses.keys() == {image.name for image in before.images}
        assert (lenses["view_000.png"]["model"], lenses["view_000.png"]["width"]) == (
            bent.model, bent.width,
        )  # fmt: skip
        assert lenses["view_000.png"]["params"] == pytest.approx(bent.params)
    assert [each.name for each in tmp_path.iterdir() if each.name.startswith(".")] == []


def test_photographs_may_be_resized_copies(distorted, tmp_path, splatseed):
    path, out = shutil.copytree(distorted, tmp_path / "scene"), tmp_path / "straight"
    for photograph in (path / "images").iterdir():
        with Image.open(photograph) as picture:
            picture.resize((48, 36)).save(photograph)
    run = splatseed("undistort", path, "-o", out)
    assert run.code == 0, run
    before, after = load_scene(path), load_scene(out)
    lens = after.intrinsics[0]
    assert load_views(after, after.images[:1])[0].width == lens.width < 56
    np.testing.assert_allclose(lens.K[0, 0], before.intrinsics[0].K[0, 0] / 2, rtol=0.1)


def test_an_upsampled_scene_keeps_what_is_known_of_its_points(distorted, tmp_path, splatseed):
    """From a layout whose points are turned, and again from COLMAP's."""
    seeded, out, twice = (tmp_path / name for name in ("seeded", "straight", "twice"))
    how = ("--method", "mls", "--ratio", 2, "--format", "transforms")
    assert splatseed("upsample", distorted, *how, "-o", seeded).code == 0
    run = splatseed("undistort", seeded, "-o", out)
    assert f"splatseed train {out} -o RUN" in run.out, run
    before, after = load_scene(seeded).points, load_scene(out).points
    assert 0 < before.num_original < len(before)
    np.testing.assert_allclose(after.xyz, before.xyz, atol=1e-5)
    np.testing.assert_array_equal(after.source, before.source)
    np.testing.assert_array_equal(after.normals, before.normals)
    assert "train it" in splatseed("info", out).out
    assert splatseed("undistort", out, "-o", twice).code == 0  # and again
    np.testing.assert_array_equal(load_scene(twice).points.source, before.source)
    assert was_upsampled(load_scene(twice))
    facts = json.loads((seeded / "splatseed.json").read_text())
    facts["parameters"]["test_every"] = 0
    del facts["listed_tests_held_out"]
    (seeded / "splatseed.json").write_text(json.dumps(facts))
    assert splatseed("undistort", seeded, "-o", out, "--overwrite").code == 0
    assert saw_all_photographs(load_scene(out))


def test_train_prints_the_command_that_mends_the_scene(distorted, tmp_path, splatseed, monkeypatch):
    pytest.importorskip("gsplat", reason="training needs PyTorch and gsplat's strategies")
    shutil.copytree(distorted, tmp_path / "my scene", symlinks=True)
    monkeypatch.chdir(tmp_path)
    run = splatseed("train", "my scene", "-o", "run", "--max-steps", 2)
    command = "splatseed undistort 'my scene' -o 'my scene_undistorted'"
    assert (run.code, command in run.err) == (2, True), run.err
    assert not (tmp_path / "run").exists()


def test_a_scene_that_lacks_something_is_refused(distorted, tmp_path, splatseed):
    path = write_scene(load_scene(distorted), tmp_path / "own", copy_images=True).path
    (path / "images/view_003.png").unlink()
    run = splatseed("undistort", path, "-o", tmp_path / "some")
    assert (run.code, run.err.count("1 of 12 images is missing")) == (0, 1), run
    some, whole = load_scene(tmp_path / "some"), load_scene(path)
    assert {image.name for image in some.images} == {
        f"view_{i:03}.png" for i in range(12) if i != 3
    }
    assert [i.name for i in some.split()[1]] == [i.name for i in whole.split()[1]]
    photographs = sorted((path / "images").iterdir())
    for gone in (*photographs[:6], path / "sparse/0/images.bin"):
        gone.unlink()
        if gone in photographs[:5]:
            continue
        run = splatseed("undistort", path, "-o", tmp_path / "out")
        assert (run.code, run.err.count("\n")) == (2, 1)
        assert "photographs" in run.err if gone in photographs else gone.name in run.err
        assert not (tmp_path / "out").exists()


def test_what_is_undistorted_follows_the_lens_not_its_coefficients(distorted, tmp_path):
    """A fisheye without coefficients is resampled; models that are pinholes become PINHOLE."""
    scene = load_scene(distorted)
    old = scene.images[0].intrinsics
    straight = old.pinhole.params
    lenses = [
        dataclasses.replace(old, camera_id=i, model=model, params=(*straight, *terms))
        for i, (model, terms) in enumerate(
            [("FISHEYE", ()), ("EUCM", (0.5, 1.1)), ("EUCM", (0.0, 1.1)), ("OPENCV", (0.0,) * 4)], 1
        )
    ]
    images = tuple(
        dataclasses.replace(image, intrinsics=lens, observations=None)
        for image, lens in zip(scene.images, lenses, strict=False)
    )
    scene = scene.replace(images=images, intrinsics=tuple(lenses), tracks=None, listed=None)
    out = undistort(scene, tmp_path / "straight").path
    after = load_scene(out)
    assert {image.intrinsics.model for image in after.images} == {"PINHOLE"}
    same = [
        (out / "images" / image.name).read_bytes()
        == (distorted / "images" / image.name).read_bytes()
        for image in scene.images
    ]
    assert same == [False, False, True, True]
    assert after.images[3].intrinsics.params == straight
    fisheye, pinhole = lenses[0], after.images[0].intrinsics
    # The middle, as its rays see it through the lens
    rows, columns = np.mgrid[20 : pinhole.height - 20, 20 : pinhole.width - 20]
    uv = np.stack([columns, rows], axis=-1) + 0.5
    u, v = np.moveaxis(project_rays(fisheye, unproject_pixels(pinhole, uv)) - 0.5, -1, 0)
    before, written = (
        np.asarray(Image.open(folder / "images" / images[0].name).convert("L"), float)
        for folder in (distorted, out)
    )
    difference = np.abs(map_coordinates(before, [v, u], order=1) - written[rows, columns])
    assert difference.mean() < 1


@pytest.mark.parametrize("layout", ["colmap", "transforms"])
def test_a_model_without_distortion_is_written_as_pinhole(layout, distorted, tmp_path):
    scene = load_scene(distorted)
    old = scene.images[0].intrinsics
    lens = dataclasses.replace(old, model="DIVISION", params=(*old.pinhole.params, 0.0))
    images = tuple(dataclasses.replace(image, intrinsics=lens) for image in scene.images)
    scene = scene.replace(images=images, intrinsics=(lens,))
    written = load_scene(write_scene(scene, tmp_path / "out", format=layout).path)
    assert written.images[0].intrinsics.model == "PINHOLE"
    assert written.images[0].intrinsics.params == old.pinhole.params
    assert not lens_findings(scene.images)


@pytest.mark.parametrize("kind", ["10 bits", "transparent"])
def test_photographs_that_pycolmap_misreads_stay_as_they_are_read(kind, distorted, tmp_path):
    """It has four grey levels for 10 bits in 16, and shows colours of transparent pixels."""
    path = shutil.copytree(distorted, tmp_path / "scene", symlinks=False)
    for image in load_scene(path).images:
        file = path / "images" / image.name
        pixels = np.asarray(Image.open(file).convert("RGBA")).copy()
        if kind == "10 bits":
            file.write_bytes(png16(np.rint(pixels[..., :3] * (1023 / 255))))
        else:
            pixels[:, :60, 3] = 0
            Image.fromarray(pixels).save(file)
    scene = load_scene(path)
    before = undistort(load_scene(distorted), tmp_path / "plain").path
    after = load_scene(undistort(scene, tmp_path / "straight").path)
    for image in after.images:
        expected = np.asarray(Image.open(before / "images" / image.name), int)
        left = expected.shape[1] // 3  # columns well within the transparent ones
        if kind == "transparent":
            assert not image.read()[:, :left].any()
        visible = np.s_[:] if kind == "10 bits" else np.s_[:, 2 * left :]
        assert np.abs(image.read()[visible] - expected[visible]).max() <= 2
    assert (after.source.root / "masks").is_dir() == (kind == "transparent")
