"""RTAB-Map's exports: projections by OpenCV's model, depth, and what is left out."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.spatial.transform import Rotation

from splatseed.errors import SceneFormatError, SceneNotFoundError

from .exports import SIZE, check_projections, kinds, load, made_cameras, write_photographs

IDS = ["3", "8", "20", "100"]
RATIONAL = [-0.2, 0.05, 0.002, -0.003, 0.01, 0.1, -0.02, 0.005]


def opencv(rays, terms):
    """OpenCV's projectPoints, pixels from the centre of the first; + 0.5 for the image corner."""
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    k1, k2, p1, p2, k3, k4, k5, k6 = [*terms, *[0.0] * 8][:8]
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = 81 * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + 47.25
    v = 82 * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + 35.5
    return np.stack([u, v], axis=1) + 0.5


def write(root, made, terms, names=IDS):
    write_photographs(root / "map_rgb", [f"{name}.jpg" for name in names])
    lines = ["#timestamp x y z qx qy qz qw id"]
    (root / "map_calib").mkdir()
    for i, name in enumerate(names):
        quat = Rotation.from_matrix(made.rotations[i].T).as_quat()
        stamp = f"1525.0{i}0000"
        numbers = " ".join(repr(float(each)) for each in (*made.centers[i], *quat))
        lines.append(f"{stamp} {numbers} {IDS[i]}")
        model = "rational_polynomial" if len(terms) > 5 else "plumb_bob"
        matrices = {"camera_matrix": (3, 3, [81, 0, 47.25, 0, 82, 35.5, 0, 0, 1]),
                    "distortion_coefficients": (1, len(terms), terms)}  # fmt: skip
        text = f'%YAML:1.0\n---\ncamera_name: "{name}"\nimage_width: {SIZE[0]}\n'
        text += f"image_height: {SIZE[1]}\n"
        for key, (rows, columns, data) in matrices.items():
            values = ",\n       ".join(f"{value:.16e}" for value in data)
            text += f"{key}:\n   rows: {rows}\n   cols: {columns}\n   data: [ {values} ]\n"
        (root / f"map_calib/{name}.yaml").write_text(f"{text}distortion_model: {model}\n")
    (root / "map_camera_poses.txt").write_text("\n".join(lines) + "\n-1 0 0 0 0 0 0 1 -4\n")


@pytest.mark.parametrize("terms", [[0.0] * 5, RATIONAL[:5], RATIONAL])
@pytest.mark.parametrize("named", ["ids", "stamps"])
def test_projections_are_opencvs(tmp_path, terms, named):
    made = made_cameras()
    names = IDS if named == "ids" else [f"1525.0{i}0000" for i in range(4)]
    write(tmp_path, made, terms, names)
    (tmp_path / "map_depth").mkdir()
    for i, name in enumerate(names):
        depth = np.full(SIZE[::-1], 1000 + i, np.uint16)
        PilImage.fromarray(depth).save(tmp_path / f"map_depth/{name}.png")
    read = load(tmp_path)
    assert read.source.format == "rtabmap"
    assert kinds(read) == ({"lens-distortion"} if any(terms) else set())
    order = sorted(range(4), key=lambda i: f"{names[i]}.jpg")
    expected = [opencv(made.rays(i), terms) for i in order]
    check_projections(read, made, expected, [f"{names[i]}.jpg" for i in order])
    np.testing.assert_allclose(read.depths.read(f"{names[3]}.jpg").values, 1.003)


def test_what_is_left_out_and_damaged(tmp_path):
    made = made_cameras()
    write(tmp_path, made, [0.0] * 5)
    write_photographs(tmp_path / "map_rgb", ["9.jpg"])
    (found,) = load(tmp_path).findings
    assert (found.kind, found.subjects) == ("missing-poses", ("9.jpg",))
    path = tmp_path / "map_camera_poses.txt"
    text = path.read_text()
    path.write_text(text.replace(" 20\n", "\n"))
    with pytest.raises(SceneFormatError, match=r"qx qy qz qw id in .*line 4"):
        load(tmp_path)
    path.write_text(text)
    calibration = tmp_path / "map_calib/3.yaml"
    whole = calibration.read_text()
    for key in ("camera_matrix", "image_width", "distortion_model"):
        calibration.write_text(whole.replace(key, "key"))
        with pytest.raises(SceneFormatError, match=rf"3\.yaml.*no {key}"):
            load(tmp_path)
    calibration.write_text(whole.replace(f"width: {SIZE[0]}", "width: 640"))
    with pytest.raises(SceneFormatError, match=r"3\.yaml.*640 x 72"):
        load(tmp_path)
    calibration.unlink()
    with pytest.raises(SceneNotFoundError, match=r"3\.yaml"):
        load(tmp_path)
