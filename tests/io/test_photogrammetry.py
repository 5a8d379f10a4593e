"""What readers of exports share: photographs by name, lenses, several files, damaged files."""

from __future__ import annotations

import json
import random
import re

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError, SplatseedError
from splatseed.io import load_scene
from splatseed.io.camera_records import brown
from splatseed.io.load import is_scene
from splatseed.io.photogrammetry import _R8, _without_r8, find_photographs, with_r8
from splatseed.io.ply import write_ply
from splatseed.lens import project_rays
from splatseed.pointcloud import PointCloud

from . import (
    test_bundler as bundler,
    test_meshroom as meshroom,
    test_metashape as metashape,
    test_openmvg as openmvg,
    test_opensfm as opensfm,
    test_realityscan as realityscan,
    test_rtabmap as rtabmap,
)
from .exports import SIZE, load, made_cameras, write_photographs

VALUES = ("nan", "-inf", "1e400", "-1", "0", "null", "[]", '""', "{}", "\ufffd", "x")


@pytest.mark.parametrize(
    ("files", "names", "found"),
    [
        (["a.jpg", "b.jpg"], ["a.jpg", "b"], ["a.jpg", "b.jpg"]),
        (["a.JPG"], ["A.jpg"], ["a.JPG"]),
        (["a.png"], ["a.jpg"], ["a.png"]),  # undistorted copies
        (["a.v2.jpg"], ["a.v2"], ["a.v2.jpg"]),
        (["x/1.jpg", "y/1.jpg"], ["C:\\data\\x\\1.jpg", "y/1.jpg"], ["x/1.jpg", "y/1.jpg"]),
        (["x/1.jpg", "y/1.jpg"], ["1.jpg", "/data/y/1.jpg"], [None, "y/1.jpg"]),
        (["y/1.jpg"], ["x/1.jpg", "y/1.jpg"], [None, "y/1.jpg"]),
        (["a.jpg", "a_mask.png"], ["a"], ["a.jpg"]),
        (["a.jpg"], ["a", "a.jpg"], [None, "a.jpg"]),
    ],
)
def test_photographs_by_name(tmp_path, files, names, found):
    write_photographs(tmp_path / "images", files)
    folder, matched, ambiguous = find_photographs(tmp_path, names)
    assert folder == tmp_path / "images"
    assert [matched.get(name) for name in names] == found
    assert ambiguous == {name for name, file in zip(names, found, strict=True) if file is None}


def test_the_folder_of_photographs(tmp_path):
    root = tmp_path / "scene"
    names = ["a.jpg", "b.jpg"]
    for folder in ("depth_maps", "shots", "images_2"):
        write_photographs(root / folder, names)
    assert find_photographs(root, names)[0] == root / "images_2"
    assert find_photographs(root, ["a.jpg", "c.jpg", "d.jpg"])[0] == root / "images_2"
    for path in (root / "images_2").iterdir():
        path.unlink()
    assert find_photographs(root, names)[0] == root / "shots"
    write_photographs(tmp_path / "images", names)
    (tmp_path / "opensfm").mkdir()
    assert find_photographs(tmp_path / "opensfm", names)[0] == tmp_path / "images"
    assert find_photographs(tmp_path / "opensfm", ["c.jpg"]) == (None, {}, set())


def test_a_term_of_r8_is_fitted_within_the_image():
    """A drone's lens, of Metashape."""
    size, f, center = (5280, 3956), (3706.0, 3705.47), (2651.67, 1950.25)
    k = (-0.0919, -0.0763, 0.1163, -0.0761)
    lens = with_r8(brown(f, center, k[:3], (0.0001, -0.0003)), k[3])
    assert lens[0] == _R8
    (model, params), error = _without_r8("", lens, size)
    r = np.stack(np.meshgrid(np.linspace(-0.7, 0.7, 15), np.linspace(-0.52, 0.52, 15)), -1)
    r2 = (r**2).sum(axis=-1, keepdims=True)
    radial = 1 + sum(k[i] * r2 ** (i + 1) for i in range(4))
    x, y = r[..., 0], r[..., 1]
    p1, p2, squared = 0.0001, -0.0003, r2[..., 0]
    u = 2 * p1 * x * y + p2 * (squared + 2 * x * x)
    v = 2 * p2 * x * y + p1 * (squared + 2 * y * y)
    tangential = np.stack([u, v], axis=-1)
    off = project_rays(Intrinsics(1, model, *size, params), r) - (
        (r * radial + tangential) * f + center
    )
    assert np.abs(off).max() <= error < 0.2
    assert with_r8(brown(f, center), 0.0) == brown(f, center)


def test_of_several_files_the_largest_is_read(tmp_path):
    made = made_cameras()
    write_photographs(tmp_path / "images", opensfm.NAMES)
    write_photographs(tmp_path / "images", realityscan.NAMES)
    realityscan.write(tmp_path, realityscan.rows(made, realityscan.LENS))
    (tmp_path / "cameras.csv").rename(tmp_path / "b.csv")
    realityscan.write(tmp_path, realityscan.rows(made, realityscan.LENS)[:2])
    read = load(tmp_path)
    assert len(read.images) == 4
    assert "b.csv is read" in next(e.text for e in read.findings if e.kind == "several-models")
    assert len(load(tmp_path / "cameras.csv").images) == 2


def test_gaussians_are_no_points(tmp_path):
    made = made_cameras()
    write_photographs(tmp_path / "images", realityscan.NAMES)
    realityscan.write(tmp_path, realityscan.rows(made, realityscan.LENS))
    head = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
    head += "property float z\nproperty float f_dc_0\nend_header\n0 0 0 1\n"
    (tmp_path / "a.ply").write_text(head)
    assert not len(load(tmp_path).points)
    write_ply(tmp_path / "b.ply", PointCloud(made.xyz, made.rgb.astype(np.uint8)))
    assert load(tmp_path).source.points_path == tmp_path / "b.ply"


def test_spherical_cameras_are_panoramas_of_their_size(tmp_path):
    made = made_cameras()
    folders = [tmp_path / program for program in ("metashape", "opensfm", "openmvg")]
    for folder, names in zip(folders, (metashape.NAMES, opensfm.NAMES, openmvg.NAMES), strict=True):
        write_photographs(folder / "images", names)
    size = f'<resolution width="{SIZE[0]}" height="{SIZE[1]}"/>'
    whole = f'<sensor id="0" label="360" type="spherical">{size}</sensor>'
    metashape.write(folders[0], made, [whole], metashape.NAMES)
    opensfm.write(folders[1] / "reconstruction.json", made, [{"projection_type": "spherical"}])
    views = openmvg.scene_of(made, posed=4)
    for each in views["intrinsics"]:
        data = {"width": SIZE[0], "height": SIZE[1]}
        each["value"] = {"polymorphic_name": "spherical", "ptr_wrapper": {"id": 9, "data": data}}
    (folders[2] / "sfm_data.json").write_text(json.dumps(views))
    for folder in folders:
        read = load_scene(folder, require_points=False, panoramas=True)
        assert len(read.images) == 4
        for image, rotation in zip(read.images, made.rotations, strict=True):
            assert image.intrinsics.model == "EQUIRECTANGULAR"
            assert image.intrinsics.params == SIZE == (image.lens.width, image.lens.height)
            np.testing.assert_allclose(image.camera.cam_from_world[:3, :3], rotation, atol=1e-9)
        with pytest.raises(SceneFormatError, match="splatseed undistort"):
            load(folder)


def write_each(root):
    """An export of each program; returns its file."""
    made = made_cameras(5)
    write_photographs(root / "images", {*bundler.NAMES, *realityscan.NAMES})
    (root / "list.txt").write_text("\n".join(bundler.NAMES))
    bundler.write(root / "bundle.out", made)
    realityscan.write(root, realityscan.rows(made, (*realityscan.LENS[:6], 0.01, 0.0, 0.0)))
    sensors = [metashape.sensor(0, metashape.FRAME | {"k4": 0.01, "b2": 0.1})]
    metashape.write(root, made, sensors, metashape.NAMES)
    opensfm.write(root / "reconstruction.json", made)
    (root / "sfm_data.json").write_text(json.dumps(openmvg.scene_of(made)))
    meshroom.write(root / "cameras.sfm", meshroom.scene_of(made))
    rtabmap.write(root, made, rtabmap.RATIONAL)
    return ("bundle.out", "cameras.csv", "cameras.xml", "reconstruction.json", "sfm_data.json",
            "cameras.sfm", "map_camera_poses.txt", "map_calib/3.yaml")  # fmt: skip


@pytest.mark.filterwarnings("error")
def test_damaged_files_are_read_or_our_errors(tmp_path):
    draw = random.Random(3)  # noqa: S311
    for name in write_each(tmp_path):
        path = tmp_path / name
        export = tmp_path / "map_camera_poses.txt" if name.startswith("map") else path
        assert is_scene(tmp_path)
        whole = path.read_text()
        places = [found.span() for found in re.finditer(r'"[^"]*"|[-\d.e]+|\[|\{', whole)]
        texts = [whole[: draw.randrange(len(whole))] for _ in range(5)]
        for _ in range(20):
            start, end = draw.choice(places)
            texts.append(whole[:start] + draw.choice(VALUES) + whole[end:])
        for text in texts:
            path.write_text(text)
            try:
                load(export)
            except SplatseedError as error:
                assert str(error)  # noqa: PT017  (no error is as good as ours)
        path.write_text(whole)
        load(export)
