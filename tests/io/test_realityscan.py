"""RealityScan: projections by the camera math of its makers, and what is left out."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud

from .exports import SIZE, check_projections, kinds, load, made_cameras, write_photographs

NAMES = [f"frame {i}.png" for i in range(4)]
HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
LENS = (30.0, 0.011, -0.007, -0.1, 0.05, -0.02, 0.0, 0.003, -0.002)


def rows(made, lens, names=NAMES):
    found = []
    for i, name in enumerate(names):
        # world_from_cam, in axes right, up, back: turned by -heading about z, then pitch, then roll
        turn = Rotation.from_matrix(made.rotations[i].T @ np.diag([1, -1, -1]))
        heading, pitch, roll = turn.as_euler("ZXY", degrees=True)
        numbers = (*made.centers[i], -heading, pitch, roll, *lens)
        found.append(",".join([name, *(repr(float(each)) for each in numbers)]))
    return found


def camera_math(rays, lens, size=SIZE):
    """RealityCapture XMP camera math: image coordinates are in units of the longer side."""
    f, px, py, k1, k2, k3, k4, t1, t2 = lens
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    xd = x * radial + t2 * (r2 + 2 * x * x) + 2 * t1 * x * y
    yd = y * radial + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y
    u, v = f / 36 * xd + px, f / 36 * yd + py
    side = max(size)
    return np.stack([side * u + size[0] / 2, side * v + size[1] / 2], axis=1)


def write(root, lines, *, header=HEADER):
    root.mkdir(exist_ok=True)
    (root / "cameras.csv").write_text("\n".join([header, *lines]) + "\n", "utf-8-sig")


@pytest.mark.parametrize("size", [SIZE, SIZE[::-1]])
def test_projections_are_those_of_the_camera_math(tmp_path, size):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root, NAMES, size)
    write(root, rows(made, LENS), header=f"#cameras 4\n{HEADER}")
    write_ply(root / "sparse.ply", PointCloud(made.xyz, made.rgb.astype(np.uint8)))
    for path in (root, root / "cameras.csv"):
        read = load(path)
        assert (read.source.format, kinds(read)) == ("realityscan", {"lens-distortion"})
        assert (read.source.image_dir, read.source.root) == (root, root)
        check_projections(
            read, made, [camera_math(made.rays(i), LENS, size) for i in range(4)], NAMES
        )
        np.testing.assert_array_equal(read.points.xyz, made.xyz.astype(np.float32))


def test_columns_are_those_of_the_header(tmp_path):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "images", [*NAMES[:3], "new.png"])
    lines = [[*line.split(",")[1:8], line.split(",")[0]] for line in rows(made, LENS)]
    write(root, [",".join(line) for line in lines], header="x,y,alt,heading,pitch,roll,f,name")
    read = load(root)
    pinhole = (LENS[0], *[0.0] * 8)
    check_projections(read, made, [camera_math(made.rays(i), pinhole) for i in range(3)], NAMES[:3])
    found = {(each.kind, each.subjects) for each in read.findings}
    assert found == {("missing-photographs", (NAMES[3],)), ("missing-poses", ("new.png",))}


def test_what_colmap_cannot_express_is_approximated(tmp_path):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "images", NAMES)
    write(root, rows(made, (*LENS[:6], 0.03, *LENS[7:])))
    (found,) = [each for each in load(root).findings if each.kind == "approximated-distortion"]
    assert found.severity == "info"


def test_damaged_files_are_one_error(tmp_path):
    made = made_cameras()
    root = tmp_path / "scene"
    write(root, rows(made, LENS))
    with pytest.raises(SceneNotFoundError, match=r"photographs of .*cameras\.csv"):
        load(root)
    write_photographs(root / "images", NAMES)
    lines = rows(made, LENS)
    for damaged, match in (
        ([*lines[:3], lines[3][:-25]], "line 5"),
        ([*lines[:3], lines[3].replace("30.0", "3o")], "a number f in .*line 5"),
        ([line.replace(",30.0,", ",nan,") for line in lines], "finite camera parameters"),
    ):
        write(root, damaged)
        with pytest.raises(SceneFormatError, match=match):
            load(root)
    write(root, [lines[0].replace(repr(float(made.centers[0, 0])), "inf"), *lines[1:]])
    assert "unusable-images" in kinds(load(root))
    write(root, [])
    with pytest.raises(SceneNotFoundError, match="photographs with poses"):
        load(root)
