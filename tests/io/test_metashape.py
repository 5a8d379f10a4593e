"""Metashape: projections by the manual's formulas, what is left out, and points beside."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.ply import write_ply
from splatseed.lens import project_rays
from splatseed.pointcloud import PointCloud

from .exports import SIZE, check_projections, kinds, load, made_cameras, write_photographs

NAMES = [f"IMG_{i}.png" for i in range(4)]
SCALE, TURN, SHIFT = 2.5, Rotation.from_euler("xyz", [40, 10, 70], degrees=True), [3.0, -2, 9]


def manual(rays, c, fisheye=False):
    """The appendix "Camera models" of the manual, for a frame camera or a fisheye."""
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    if fisheye:
        r0 = np.sqrt(x**2 + y**2)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r = np.sqrt(x**2 + y**2)
    k = [c.get(f"k{i}", 0) for i in range(1, 5)]
    p1, p2 = c.get("p1", 0), c.get("p2", 0)
    radial = 1 + k[0] * r**2 + k[1] * r**4 + k[2] * r**6 + k[3] * r**8
    xd = x * radial + (p1 * (r**2 + 2 * x**2) + 2 * p2 * x * y)
    yd = y * radial + (p2 * (r**2 + 2 * y**2) + 2 * p1 * x * y)
    f, b1, b2 = c["f"], c.get("b1", 0), c.get("b2", 0)
    u = SIZE[0] * 0.5 + c.get("cx", 0) + xd * f + xd * b1 + yd * b2
    return np.stack([u, SIZE[1] * 0.5 + c.get("cy", 0) + yd * f], axis=1)


def sensor(i, numbers, kind="frame"):
    size = f'<resolution width="{SIZE[0]}" height="{SIZE[1]}"/>'
    first = f'<calibration type="{kind}" class="initial">{size}<f>50</f></calibration>'
    values = "".join(f"<{key}>{value!r}</{key}>" for key, value in numbers.items())
    last = f'<calibration type="{kind}" class="adjusted">{size}{values}</calibration>'
    return f'<sensor id="{i}" label="unknown" type="{kind}">{size}{first}{last}</sensor>'


def write(root, made, sensors, labels, *, own=(), scene="component", more=""):
    """``own``: the sensor's id of each camera; ``scene``: where the transform stands."""
    numbers = " ".join(repr(float(each)) for each in TURN.as_matrix().ravel())
    transform = f"""<transform><rotation locked="0">{numbers}</rotation>
        <translation>{" ".join(map(str, SHIFT))}</translation><scale>{SCALE}</scale></transform>"""
    cameras = []
    for i, label in enumerate(labels):
        # world = SCALE TURN chunk + SHIFT
        center = TURN.inv().apply(made.centers[i] - SHIFT) / SCALE
        pose = np.eye(4)
        pose[:3] = np.column_stack([TURN.inv().as_matrix() @ made.rotations[i].T, center])
        values = " ".join(repr(float(each)) for each in pose.ravel())
        which = own[i] if own else 0
        cameras.append(
            f'<camera id="{i}" sensor_id="{which}" component_id="0" label="{label}">'
            f"<transform>{values}</transform><orientation>1</orientation></camera>"
        )
    component = f'<components><component id="0">{transform}</component></components>'
    root.mkdir(exist_ok=True)
    (root / "cameras.xml").write_text(f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="9">{"".join(sensors)}</sensors>{component if scene == "component" else ""}
<cameras next_id="9"><group id="0">{"".join(cameras)}</group>{more}</cameras>
{transform if scene == "chunk" else ""}</chunk></document>""")


FRAME = {"f": 81.5, "cx": 2.25, "cy": -1.5, "k1": -0.11, "k2": 0.03, "k3": -0.01, "p1": 0.004,
         "p2": -0.002, "b1": 0.75}  # fmt: skip
FISHEYE = {"f": 60.0, "cx": -1.0, "k1": 0.02, "k2": -0.01, "k3": 0.004, "k4": -0.002, "p1": 0.001,
           "p2": 0.003}  # fmt: skip


@pytest.mark.parametrize("scene", ["component", "chunk"])
def test_projections_are_the_manuals(tmp_path, scene):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "images", NAMES)
    sensors = [sensor(0, FRAME), sensor(1, FISHEYE, "fisheye")]
    labels = ["IMG_0", "IMG_1.JPG", "IMG_2", "IMG_3"]
    write(root, made, sensors, labels, own=[0, 1, 0, 1], scene=scene)
    write_ply(root / "cloud.ply", PointCloud(made.xyz, made.rgb.astype(np.uint8)))
    for path in (root, root / "cameras.xml"):
        read = load(path)
        assert (read.source.format, kinds(read)) == ("metashape", {"lens-distortion"})
        assert {image.intrinsics.model for image in read.images} == {
            "FULL_OPENCV", "THIN_PRISM_FISHEYE"
        }  # fmt: skip
        lenses = [FRAME, FISHEYE, FRAME, FISHEYE]
        expected = [manual(made.rays(i), c, c is FISHEYE) for i, c in enumerate(lenses)]
        check_projections(read, made, expected, NAMES)
        np.testing.assert_array_equal(read.points.xyz, made.xyz.astype(np.float32))
        np.testing.assert_array_equal(read.points.rgb, made.rgb)


def test_what_colmap_cannot_express_is_stated(tmp_path):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "images", NAMES)
    lens = {"f": 81.5, "k1": -0.11, "k2": 0.06, "k3": -0.04, "k4": 0.03}
    write(root, made, [sensor(0, lens)], NAMES)
    read = load(root)
    (found,) = [each for each in read.findings if each.kind == "approximated-distortion"]
    assert found.severity == "info"
    for i, image in enumerate(read.images):
        expected = manual(made.rays(i), lens)
        inside = ((expected > 0) & (expected < SIZE)).all(axis=1)
        rays = made.rays(i)
        seen = project_rays(image.intrinsics, rays[:, :2] / rays[:, 2:])
        assert np.abs(seen - expected)[inside].max() < 1e-3
    write(root, made, [sensor(0, {"f": 80.0, "b2": 0.5})], NAMES)
    (found,) = [each for each in load(root).findings if each.kind == "ignored-distortion"]
    assert "b2" in found.text
    assert "0.23 px" in found.text  # 0.5 * 36 / 80


def test_what_is_left_out_is_stated(tmp_path):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "photos", [*NAMES, "off.png", "lost.png", "new.png"])
    write_photographs(root / "depth", NAMES)
    more = '<camera id="7" sensor_id="0" label="off" enabled="false"><transform>1</transform>'
    more += '</camera><camera id="8" sensor_id="0" label="lost"/>'
    write(root, made, [sensor(0, {"f": 80.0})], NAMES, more=more)
    read = load(root)
    assert read.source.image_dir == root / "photos"
    found = {(each.kind, each.subjects) for each in read.findings}
    assert found == {
        ("disabled-cameras", ("off",)),
        ("missing-poses", ("lost",)),
        ("missing-poses", ("new.png",)),
    }
    (root / "photos/IMG_2.png").unlink()
    assert "missing-photographs" in kinds(load(root))
    assert len(load(root).images) == 4


def test_names_that_fit_several_files_are_left_out(tmp_path):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "images", ["a/IMG_0.png", "b/IMG_0.png", "a/IMG_2.png", "b/IMG_3.png"])
    write(root, made, [sensor(0, {"f": 80.0})], ["IMG_0", "IMG_0", "IMG_2", "IMG_3"])
    read = load(root)
    assert [image.name for image in read.images] == ["a/IMG_2.png", "b/IMG_3.png"]
    (found,) = [each for each in read.findings if each.kind == "missing-photographs"]
    assert found.subjects == ("IMG_0", "IMG_0")


def test_damaged_files_are_one_error(tmp_path):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "images", NAMES)
    write(root, made, [sensor(0, {"f": 80.0}, "cylindrical")], NAMES)
    with pytest.raises(SceneFormatError, match=r"cylindrical.*undistort"):
        load(root)
    write(root, made, [sensor(0, {"f": float("nan")})], NAMES)
    with pytest.raises(SceneFormatError, match="finite camera parameters"):
        load(root)
    write(root, made, [], NAMES)
    with pytest.raises(SceneNotFoundError, match="4 without a pose"):
        load(root)
    write(root, made, [sensor(0, {"f": 80.0})], NAMES)
    text = (root / "cameras.xml").read_text()
    for damaged in (text[:-30], text.replace("<scale>2.5", "<scale>-1")):
        (root / "cameras.xml").write_text(damaged)
        with pytest.raises(SceneFormatError, match=r"cameras\.xml"):
            load(root)
