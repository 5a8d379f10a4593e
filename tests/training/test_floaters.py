"""Floaters go, what the photographs need stays, and ``export --clean`` says what it did."""

from __future__ import annotations

import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from splatseed.camera import Camera
from splatseed.errors import MissingDependencyError, SceneFormatError
from splatseed.io import write_scene
from splatseed.photos.view import View, camera_views
from splatseed.pointcloud import PointCloud
from splatseed.splat.evaluate import evaluate_model, load_model
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import SH_C0, Gaussians
from splatseed.splat.model_frame import find_transform, transform_gaussians
from splatseed.splat.pictures import to_uint8
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import training_frame
from splatseed.training import floaters
from splatseed.training.floaters import find_floaters

CPU = torch.device("cpu")
NUM_FLOATERS = 100


def round_gaussians(means, sizes, colors, opacity):
    """Opaque balls of one colour."""
    count = len(means)
    arrays = {
        "means": means,
        "scales": np.log(np.broadcast_to(np.asarray(sizes)[..., None], (count, 3))),
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "opacities": np.full(count, np.log(opacity / (1 - opacity))),
        "sh0": (colors[:, None] - 0.5) / SH_C0,
        "shN": np.zeros((count, 15, 3)),
    }
    return Gaussians(**{name: each.astype(np.float32) for name, each in arrays.items()})


def joined(*models):
    arrays = [model.arrays() for model in models]
    return Gaussians(
        **{name: np.concatenate([each[name] for each in arrays]) for name in arrays[0]}
    )


def pictured(model, view):
    """The view with the model's render as its photograph."""
    image = ModelRenderer(model, training_frame([view])).color(view)
    return dataclasses.replace(view, photograph=to_uint8(image))


@pytest.fixture
def wall(rng):
    """A wall of Gaussians at depth 3, five cameras before it, and its depth in each view."""
    x, y = (each.ravel() for each in np.meshgrid(np.arange(-2.5, 2.5, 0.1), np.arange(-2, 2, 0.1)))
    colors = rng.uniform(0.2, 0.8, (len(x), 3))
    model = round_gaussians(np.stack([x, y, np.full(len(x), 3.0)], 1), 0.08, colors, 0.9)
    K, unseen, views = np.array([[80.0, 0, 48], [0, 80, 36], [0, 0, 1]]), np.empty((0, 0, 3)), []
    for i in range(5):
        pose = np.eye(4)
        pose[0, 3] = 0.2 * (2 - i)
        views.append(View(f"{i}.png", unseen.astype(np.uint8), Camera(K, 96, 72, pose)))
    return model, views, {view.name: np.full((18, 24), 3.0, np.float32) for view in views}


def test_suspects_stay_where_the_photographs_show_them(wall, rng):
    """A pane before a wall, clear enough that stereo sees the wall, is in all photographs or none.

    What a single view sees past, or where too few depths are known, is no suspect.
    """
    model, views, depths = wall
    means = rng.uniform([-0.5, -0.4, 1.2], [0.5, -0.15, 2.0], (12, 3))
    pane = round_gaussians(means, 0.05, np.full((12, 3), 0.95), 0.3)
    both, front = joined(model, pane), np.arange(len(model) + 12) >= len(model)
    shown, bare = ([pictured(each, view) for view in views] for each in (both, model))
    assert not find_floaters(both, shown, depths, CPU).any()
    np.testing.assert_array_equal(find_floaters(both, bare, depths, CPU), front)
    far = {name: depths[name] / 2 for name in ("1.png", "2.png", "3.png", "4.png")}
    assert not find_floaters(both, bare, {**depths, **far}, CPU)[front].all()
    row, column = np.mgrid[:18, :24]
    known = (column % 2 > 0) | (row > 8)
    unknown = {name: np.where(known, each, 0) for name, each in depths.items()}
    assert not find_floaters(both, bare, unknown, CPU).any()


@pytest.mark.parametrize("factor", [0.2, 5.0])
def test_a_model_that_lies_on_no_surface_is_refused(wall, factor):
    model, views, depths = wall
    others = {name: factor * depth for name, depth in depths.items()}
    with pytest.raises(SceneFormatError, match="that the model was trained on"):
        find_floaters(model, [pictured(model, view) for view in views], others, CPU)


@pytest.fixture(scope="module")
def floating(sixteen_views, tmp_path_factory):
    """A model of the room, lifted from true depth, and 100 floaters at its end: file and count."""
    capture, scene = sixteen_views
    rng, parts, wrong = np.random.default_rng(0), [], []
    arrays = {image.name: i for i, image in enumerate(capture.scene.images)}
    for view in camera_views(scene.split()[0]):
        pixels, depth = (each[arrays[view.name]] for each in (capture.images, capture.depths))
        row, column = 1 + 3 * np.argwhere(depth[1::3, 1::3] > 0).T
        d = depth[row, column].astype(np.float64)
        rays = np.linalg.inv(view.K) @ [column + 0.5, row + 0.5, np.ones(len(d))]
        some = rng.permutation(len(d))[: 1 + NUM_FLOATERS // 14]
        for into, which, far, size, color in (
            (parts, slice(None), 1.0, 1.2, pixels[row, column] / 255),
            (wrong, some, rng.uniform(0.3, 0.7, len(d)), 2.0, rng.random((len(d), 3))),
        ):
            xyz = ((rays * d * far).T - view.cam_from_world[:3, 3]) @ view.cam_from_world[:3, :3]
            sizes = size * d / view.K[0, 0]
            into.append(round_gaussians(xyz[which], sizes[which], color[which], 0.9))
    whole, floaters = joined(*parts[::2]), joined(*wrong).select(np.arange(NUM_FLOATERS))
    folder = tmp_path_factory.mktemp("floating")
    for name, model in (("whole", whole), ("model", joined(whole, floaters))):
        write_gaussians(folder / f"{name}.ply", model)
    return folder / "model.ply", len(whole)


def psnr(path, scene):
    return evaluate_model(load_model(path, scene)).psnr


def test_export_finds_floaters_in_a_room(sixteen_views, floating, splatseed, tmp_path, monkeypatch):
    root, (path, count) = sixteen_views[1].source.root, floating
    before, out = path.read_bytes(), tmp_path / "clean.ply"
    done = splatseed("export", path, "-o", out, "--clean", root)
    assert done.code == 0, done.err
    kept, model = read_gaussians(out).means, read_gaussians(path).means
    stays = np.isin(model[:, 0], kept[:, 0])
    assert f"{len(model) - len(kept):,} left out" in done.out
    assert (~stays[count:]).mean() > 0.6
    assert (~stays[:count]).mean() < 0.01
    scores = [psnr(each, root) for each in (path, out, path.with_name("whole.ply"))]
    assert scores[1] - scores[0] > 0.7 * (scores[2] - scores[0]) > 0.7
    assert path.read_bytes() == before
    # A model in its trainer's own world is cleaned there; without gsplat's kernels on the CPU.
    fails = Mock(side_effect=MissingDependencyError("kernels", found="no nvcc", fix=""))
    monkeypatch.setattr(floaters, "pick_device", fails)
    world = find_transform("gsplat", sixteen_views[1])
    write_gaussians(tmp_path / "theirs.ply", transform_gaussians(read_gaussians(path), world))
    words = ("-o", tmp_path / "again.ply", "--clean", root)
    assert splatseed("export", tmp_path / "theirs.ply", *words).code == 0
    again = read_gaussians(tmp_path / "again.ply")
    assert abs(len(again) - len(kept)) <= 0.01 * len(kept)


def test_bad_input_leaves_no_file(floating, room, splatseed, tmp_path):
    (path, _), out = floating, tmp_path / "out.ply"
    other = room.replace(points=PointCloud(room.points.xyz + 50, room.points.rgb), tracks=None)
    write_scene(other, tmp_path / "other")
    write_scene(room.replace(images=(), tracks=None), tmp_path / "points")
    for scene, said in (
        ("own", "--clean SCENE"),
        (tmp_path / "none", "none"),
        (tmp_path / "other", "another scene"),
        (tmp_path / "points", "photographs"),
    ):
        failed = splatseed("export", path, "-o", out, "--clean", scene)
        assert failed.code == 2, failed
        assert said in " ".join(failed.err.split())
        assert "--transform" not in failed.err
        assert not out.exists()
