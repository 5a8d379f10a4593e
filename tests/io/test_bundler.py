"""Bundler: projections by its manual's formulas, and what is left out."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import SceneFormatError, SceneNotFoundError

from .exports import SIZE, check_projections, kinds, load, made_cameras, write_photographs

NAMES = [f"view {i}.png" for i in range(4)]
LENS = (85.0, -0.08, 0.03)


def manual(made, view, lens, size=SIZE):
    """P = R X + t, p = -P / P.z, p' = f r(p) p; from the image centre, y up."""
    flip = np.diag([1.0, -1, -1])
    rotation, translation = flip @ made.rotations[view], flip @ made.translations[view]
    P = made.xyz @ rotation.T + translation
    p = -P / P[:, 2:]
    f, k1, k2 = lens
    squared = (p[:, :2] ** 2).sum(axis=1, keepdims=True)
    pixels = f * (1 + k1 * squared + k2 * squared**2) * p[:, :2]
    return np.stack([size[0] / 2 + pixels[:, 0], size[1] / 2 - pixels[:, 1]], axis=1)


def write(path, made, lens=LENS, unposed=0):
    flip, lines = np.diag([1.0, -1, -1]), ["# Bundle file v0.3", f"{4 + unposed} {len(made.xyz)}"]
    for i in range(4):
        lines.append(" ".join(map(repr, lens)))
        rows = [*(flip @ made.rotations[i]), flip @ made.translations[i]]
        lines += [" ".join(repr(float(each)) for each in row) for row in rows]
    lines += ["0 0 0"] * 5 * unposed
    for xyz, rgb in zip(made.xyz, made.rgb, strict=True):
        lines += [" ".join(map(str, xyz.tolist())), " ".join(map(str, rgb)), "2 0 5 1.5 -2 1 7 3 4"]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("place", ["bundle.out", "bundle/bundle.out"])
def test_projections_are_the_manuals(tmp_path, place):
    made = made_cameras()
    root = tmp_path / "scene"
    write_photographs(root / "images", NAMES)
    write(root / place, made)
    (root / "list.txt").write_text("".join(f"./{name} 0 4523.1\n" for name in NAMES))
    (root / "notes.txt").write_text("four\nlines\nof\ntext\n")
    for path in (root, root / place):
        read = load(path)
        assert (read.source.format, kinds(read)) == ("bundler", {"lens-distortion"})
        check_projections(read, made, [manual(made, i, LENS) for i in range(4)], NAMES)
        np.testing.assert_array_equal(read.points.xyz, made.xyz.astype(np.float32))
        np.testing.assert_array_equal(read.points.rgb, made.rgb)


def test_what_has_no_pose_is_left_out(tmp_path):
    made = made_cameras()
    names = [*NAMES, "view 4.png"]
    write_photographs(tmp_path / "pictures", names)
    write(tmp_path / "a.out", made, (85.0, 0.0, 0.0), unposed=1)
    (tmp_path / "a.out.list.txt").write_text("\n".join(f"C:\\photos\\{name}" for name in names))
    read = load(tmp_path)
    check_projections(read, made, [manual(made, i, (85.0, 0, 0)) for i in range(4)], NAMES)
    assert [(each.kind, each.subjects) for each in read.findings] == [
        ("missing-poses", ("C:\\photos\\view 4.png",))
    ]
    assert {image.intrinsics.model for image in read.images} == {"SIMPLE_PINHOLE"}


def test_damaged_files_are_one_error(tmp_path):
    made = made_cameras()
    write_photographs(tmp_path / "images", NAMES)
    path = tmp_path / "bundle.out"
    write(path, made)
    with pytest.raises(SceneNotFoundError, match="a list of 4 photographs"):
        load(tmp_path)
    (tmp_path / "list.txt").write_text("\n".join(NAMES))
    text = path.read_text()
    for damaged in (
        text[: len(text) // 2], text.replace("4 30", "-4 30", 1), text.replace("85.0", "x", 1),
        text.replace("85.0", "85.0 3", 1), "# Bundle file v0.3\n",
    ):  # fmt: skip
        path.write_text(damaged)
        with pytest.raises(SceneFormatError, match=r"bundle\.out"):
            load(tmp_path)
    path.write_text(text.replace("85.0", "nan"))
    with pytest.raises(SceneFormatError, match="finite camera parameters"):
        load(tmp_path)
