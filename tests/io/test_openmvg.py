"""OpenMVG: projections by the formulas of its camera models, and what is left out."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed.errors import SceneFormatError, SceneNotFoundError

from .exports import SIZE, check_projections, kinds, load, made_cameras, write_photographs

NAMES = [f"100_710{i}.png" for i in range(5)]
PINHOLE = {"focal_length": 81.0, "principal_point": [47.5, 36.25]}
LENSES = {
    "pinhole": PINHOLE,
    "pinhole_radial_k1": PINHOLE | {"disto_k1": [-0.1]},
    "pinhole_radial_k3": PINHOLE | {"disto_k3": [-0.1, 0.04, -0.01]},
    "pinhole_brown_t2": PINHOLE | {"disto_t2": [-0.1, 0.04, -0.01, 0.003, -0.002]},
    "fisheye": PINHOLE | {"fisheye": [0.02, -0.01, 0.004, -0.001]},
}


def camera_models(rays, kind, c):
    """add_disto of each model, then cam2ima."""
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    r2 = x * x + y * y
    if kind == "fisheye":
        r, k = np.sqrt(r2), c["fisheye"]
        theta = np.arctan(r)
        scale = (theta + sum(k[i] * theta ** (3 + 2 * i) for i in range(4))) / r
        x, y = x * scale, y * scale
    elif kind == "pinhole_brown_t2":
        k1, k2, k3, t1, t2 = c["disto_t2"]
        radial = k1 * r2 + k2 * r2**2 + k3 * r2**3
        x, y = (
            x + x * radial + t2 * (r2 + 2 * x * x) + 2 * t1 * x * y,
            y + y * radial + t1 * (r2 + 2 * y * y) + 2 * t2 * x * y,
        )
    elif kind != "pinhole":
        k = [*c.get("disto_k1", c.get("disto_k3")), 0, 0]
        radial = 1 + k[0] * r2 + k[1] * r2**2 + k[2] * r2**3
        x, y = x * radial, y * radial
    return c["focal_length"] * np.stack([x, y], axis=1) + c["principal_point"]


def scene_of(made, root_path="/data/images", posed=5):
    views = [
        {"key": i, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": i, "data": {
            "local_path": "", "filename": name, "width": SIZE[0], "height": SIZE[1],
            "id_view": i, "id_intrinsic": i, "id_pose": i}}}}
        for i, name in enumerate(NAMES)
    ]  # fmt: skip
    intrinsics = [
        {"key": i, "value": {"polymorphic_id": i, "polymorphic_name": kind, "ptr_wrapper": {
            "id": 9 + i, "data": {"width": SIZE[0], "height": SIZE[1], **lens}}}}
        for i, (kind, lens) in enumerate(LENSES.items())
    ]  # fmt: skip
    for each in intrinsics[1::2]:
        del each["value"]["polymorphic_name"]  # cereal writes a type's name once
    extrinsics = [
        {"key": i, "value": {"rotation": made.rotations[i].tolist(),
                             "center": made.centers[i].tolist()}}
        for i in range(posed)
    ]  # fmt: skip
    structure = [
        {"key": i, "value": {"X": xyz.tolist(), "observations": []}}
        for i, xyz in enumerate(made.xyz)
    ]
    return {"sfm_data_version": "0.3", "root_path": root_path, "views": views,
            "intrinsics": intrinsics, "extrinsics": extrinsics, "structure": structure,
            "control_points": []}  # fmt: skip


def test_projections_are_those_of_the_camera_models(tmp_path):
    made = made_cameras(5)
    root = tmp_path / "scene"
    write_photographs(root / "images", NAMES)
    path = root / "sfm_data.json"
    path.write_text(json.dumps(scene_of(made), indent=4))
    for each in (root, path):
        read = load(each)
        assert (read.source.format, kinds(read)) == ("openmvg", {"lens-distortion"})
        expected = [
            camera_models(made.rays(i), kind, lens) for i, (kind, lens) in enumerate(LENSES.items())
        ]
        check_projections(read, made, expected, NAMES)
        np.testing.assert_array_equal(read.points.xyz, made.xyz.astype(np.float32))


def test_photographs_at_the_stated_path_and_views_without_a_pose(tmp_path):
    made = made_cameras(5)
    write_photographs(tmp_path / "elsewhere/photographs", NAMES)
    root = tmp_path / "matches"
    root.mkdir()
    content = scene_of(made, str(tmp_path / "elsewhere/photographs"), posed=4)
    (root / "sfm_data.json").write_text(json.dumps(content))
    read = load(root)
    assert read.source.image_dir == tmp_path / "elsewhere/photographs"
    assert kinds(read) == {"lens-distortion", "missing-poses", "photographs-outside-scene"}
    assert [image.name for image in read.images] == NAMES[:4]


def test_damaged_files_are_one_error(tmp_path):
    made = made_cameras(5)
    write_photographs(tmp_path / "images", NAMES)
    path = tmp_path / "sfm_data.json"
    path.write_text(json.dumps(scene_of(made, posed=0)))
    with pytest.raises(SceneNotFoundError, match="5 without a pose"):
        load(tmp_path)
    text = json.dumps(scene_of(made))
    for damaged in (
        text[:-20], text.replace('"center"', '"centre"'), text.replace('"principal_point"', '"p"'),
        text.replace('"rotation": [[', '"rotation": [[1, '), text.replace('"views"', '"view"'),
    ):  # fmt: skip
        path.write_text(damaged)
        with pytest.raises(SceneFormatError, match=r"sfm_data\.json"):
            load(tmp_path)
