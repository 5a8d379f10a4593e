"""Models in another world than their scene's are found out, and scored right with the transform."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

from splatseed.camera import rotation_from_quat
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene, write_scene
from splatseed.io.origin import translated
from splatseed.rendering.harmonics import sh_basis
from splatseed.similarity import Similarity, fit_similarity
from splatseed.splat.evaluate import evaluate_model, load_model
from splatseed.splat.formats import write_gaussians
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.splat.model_frame import (
    check_frame,
    find_transform,
    move_to_scene_frame,
    transform_gaussians,
)


@pytest.fixture(scope="module")
def room(larger_room_path):
    return larger_room_path


@pytest.fixture(scope="module")
def gaussians(room):
    """Flat ones in every direction, of colours that depend on it."""
    round_ones = initial_gaussians(load_scene(room).points, opacity=0.9)
    rng = np.random.default_rng(0)
    return replace(
        round_ones,
        scales=round_ones.scales - np.float32([0, 0, 1]),
        quats=rng.normal(size=round_ones.quats.shape).astype(np.float32),
        shN=0.2 * rng.normal(size=round_ones.shN.shape).astype(np.float32),
    )


@pytest.fixture(scope="module")
def psnr(room, gaussians, tmp_path_factory):
    path = tmp_path_factory.mktemp("world") / "model.ply"
    write_gaussians(path, gaussians)
    return evaluate_model(load_model(path, room)).psnr


@pytest.fixture
def other(rng):
    quat = rng.normal(size=4)
    return Similarity(0.3, rotation_from_quat(quat / np.linalg.norm(quat)), rng.normal(size=3))


def test_models_of_gsplats_examples_need_their_transform(room, gaussians, psnr, tmp_path):
    path = tmp_path / "model.ply"
    write_gaussians(
        path, transform_gaussians(gaussians, find_transform("gsplat", load_scene(room)))
    )
    with pytest.raises(SceneFormatError, match=r"transform=.gsplat"):
        load_model(path, room)
    right, wrong = (evaluate_model(load_model(path, room, transform=t)) for t in ("gsplat", "none"))
    assert right.psnr == pytest.approx(psnr, abs=0.05)
    assert wrong.psnr < psnr - 1
    write_gaussians(path, gaussians)
    with pytest.raises(SceneFormatError, match=r"transform=.none"):
        load_model(path, room, transform="gsplat")


@pytest.mark.parametrize(
    "kind", ["matrix", "transform", "dataparser_transforms.json", "cameras.json"]
)
def test_the_transform_is_read_from_a_file(kind, room, gaussians, psnr, other, tmp_path):
    path = tmp_path / "point_cloud/iteration_7/point_cloud.ply"
    path.parent.mkdir(parents=True)
    write_gaussians(path, transform_gaussians(gaussians, other))
    rows = other.matrix.tolist()
    unscaled = np.column_stack([other.rotation, other.translation / other.scale]).tolist()
    images = load_scene(room).images
    places = other.points(np.array([image.camera.center for image in images])).tolist()
    cameras = [
        {"img_name": image.name[:-4], "position": at}
        for image, at in zip(images, places, strict=True)
    ]
    content = {
        "matrix": rows,
        "transform": {"transform": [*rows, [0, 0, 0, 1]]},
        "dataparser_transforms.json": {"transform": unscaled, "scale": other.scale},
        "cameras.json": cameras,
    }[kind]
    file = tmp_path / (kind if kind.endswith("json") else "t.json")
    file.write_text(json.dumps(content))
    says = str(file) if kind.endswith("json") else "transform=FILE"
    with pytest.raises(SceneFormatError, match=says):
        load_model(path, room)
    result = evaluate_model(load_model(path, room, transform=str(file)))
    assert result.psnr == pytest.approx(psnr, abs=0.05)


def test_cameras_json_of_a_rig_pairs_cameras_by_folder(room, other, tmp_path):
    """Photographs of several cameras have equal names."""
    scene = load_scene(room)
    half = len(scene.images) // 2
    names = [f"cam{i // half}/{i % half:03}.png" for i in range(2 * half)]
    images = [
        replace(image, name=name)
        for image, name in zip(scene.images[: 2 * half], names, strict=True)
    ]
    places = other.points(np.array([image.camera.center for image in images])).tolist()
    cameras = [{"img_name": n, "position": at} for n, at in zip(names, places, strict=True)]
    (tmp_path / "cameras.json").write_text(json.dumps(cameras))
    found = find_transform(str(tmp_path / "cameras.json"), scene.replace(images=tuple(images)))
    np.testing.assert_allclose(found.matrix, other.matrix, atol=1e-6)


def test_nerfstudios_transform_starts_from_colmaps_world(room, tmp_path):
    """Which is not that of a scene that was read from transforms.json."""
    write_scene(load_scene(room), tmp_path / "nerf", format="transforms")
    scene = load_scene(tmp_path / "nerf")
    turned = Similarity(0.5, np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]]), np.array([1.0, 2, 3]))
    unscaled = np.column_stack([turned.rotation, turned.translation / 0.5]).tolist()
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps({"transform": unscaled, "scale": 0.5}))
    wanted = turned.points(load_scene(room).points.xyz)
    moved = find_transform(str(file), scene).points(scene.points.xyz)
    np.testing.assert_allclose(moved, wanted, atol=1e-5)


def test_rotated_harmonics_have_the_same_colors_in_rotated_directions(rng, gaussians, other):
    directions = rng.normal(size=(len(gaussians), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)

    def colors(model, at):
        harmonics = np.concatenate([model.sh0, model.shN], axis=1)
        return np.einsum("nk,nkc->nc", sh_basis(at, harmonics.shape[1]), harmonics)

    rotated = colors(transform_gaussians(gaussians, other), directions @ other.rotation.T)
    np.testing.assert_allclose(rotated, colors(gaussians, directions), atol=1e-5)


def test_collinear_positions_give_no_similarity(rng, other):
    line = np.outer(np.arange(5.0), rng.normal(size=3))
    for places in (line, rng.normal(size=(2, 3))):
        assert fit_similarity(places, other.points(places)) is None


@pytest.mark.parametrize(
    "text",
    [
        *("{", "# Read me\n\nfirst", "", "{}", '{"transform": [[1, 2], [3, 4]]}'),
        "[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]",
        f"[[{10**400}, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]",
        "[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0]]",
        '[{"img_name": "nobody", "position": [0, 0, 0]}]',
    ],
)
def test_invalid_transforms_are_refused(text, room, tmp_path):
    (tmp_path / "t.json").write_text(text)
    with pytest.raises(SceneFormatError, match=r"t\.json"):
        find_transform(str(tmp_path / "t.json"), load_scene(room))
    with pytest.raises(SceneNotFoundError, match=r"nowhere\.json"):
        find_transform(str(tmp_path / "nowhere.json"), load_scene(room))
    with pytest.raises(ParameterError):
        find_transform("gsplat", load_scene(room / "sparse/0/points3D.ply"))


def test_a_transform_that_would_be_refused_is_not_suggested(room, gaussians, tmp_path):
    """A small model at the origin, to which gsplat's transform only brings a far scene nearer."""
    moved = translated(load_scene(room), np.array([-1000.0, 0.0, 0.0]))
    scene = moved.replace(origin=np.zeros(3))
    small = replace(gaussians, means=gaussians.means * np.float32(1e-4))
    for given in (None, find_transform("gsplat", scene)):
        with pytest.raises(SceneFormatError, match="No known transform fits"):
            check_frame(tmp_path / "model.ply", scene, small, given)


@pytest.mark.parametrize("name", ["flipped", "turned"])
def test_a_flipped_model_is_named_and_a_cropped_one_is_accepted(
    name, room, gaussians, psnr, tmp_path
):
    """As of a .spz without converted axes, and of a model that its user cropped to a subject."""
    path, scene = tmp_path / "model.ply", load_scene(room)
    write_gaussians(path, transform_gaussians(gaussians, find_transform(name, scene)))
    with pytest.raises(SceneFormatError, match=rf"transform=.{name}"):
        load_model(path, room)
    scored = evaluate_model(load_model(path, room, transform=name))
    assert scored.psnr == pytest.approx(psnr, abs=0.05)
    distance = np.linalg.norm(gaussians.means - gaussians.means[0], axis=1)
    part = gaussians.select(np.argsort(distance)[: len(gaussians) // 4])
    notes = []
    check_frame(path, scene, part, note=notes.append)
    assert not notes
    turned = transform_gaussians(part, find_transform(name, scene))
    move_to_scene_frame(path, scene, turned, notes.append)
    assert name in str(notes[0])
    moved = replace(part, means=part.means + np.float32([0, 0, 30]))
    with pytest.raises(SceneFormatError, match="No known transform fits"):
        check_frame(path, scene, moved)


def test_a_slightly_misplaced_model_is_scored_with_a_warning(room, gaussians, tmp_path):
    """As another scene's does in a transform that happens to bring it near."""
    scene = load_scene(room)
    notes = []
    check_frame(tmp_path / "model.ply", scene, gaussians, note=notes.append)
    gap = np.median(np.linalg.norm(np.diff(gaussians.means, axis=0), axis=1))
    beside = replace(gaussians, means=gaussians.means + np.float32([0, 0, 0.4 * gap]))
    write_gaussians(tmp_path / "model.ply", beside)
    model = load_model(tmp_path / "model.ply", room)
    assert [each.kind for each in model.findings] == ["uncertain-frame"]
    assert not load_model(tmp_path / "model.ply", room, transform="none").findings
    few = gaussians.select(np.arange(0, len(gaussians), 8))  # large, they are a model still
    check_frame(tmp_path / "few.ply", scene, few, note=notes.append)
    assert not notes
