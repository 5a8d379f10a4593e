"""A COLMAP dense workspace: what COLMAP reads of it, and what it makes of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image as PilImage

from splatseed.camera import Camera
from splatseed.errors import InputError, OutputError, SceneFormatError, SceneNotFoundError
from splatseed.io import find_depths, load_scene
from splatseed.io.dense import (
    depth_along,
    write_consistency_graph,
    write_dense_maps,
    write_dense_workspace,
    write_map,
)
from splatseed.io.ply import read_ply
from splatseed.photos.undistortion import undistort
from splatseed.scene import SceneSource
from splatseed.synthetic import make_capture, write_capture

from ..bent import bend
from ..stereo_maps import true_maps

ON_SURFACE = 1e-5
"""Metres: float32 of depths of some metres."""
FLAT = 0.6
"""The share of pixels on flat surfaces: planes through curved ones and leaves lie beside them."""
PIXEL = 0.03
"""Metres, of a photograph at the room's depth."""


@pytest.fixture(scope="module")
def capture():
    """Sizes that no factor divides, so that maps are of another shape than their photographs."""
    return make_capture(0, num_views=8, width=97, height=73)


@pytest.fixture(scope="module")
def room(capture, tmp_path_factory):
    return load_scene(write_capture(capture, tmp_path_factory.mktemp("room") / "room"))


@pytest.fixture(scope="module")
def maps(capture):
    """By the factor that they are smaller than the photographs."""
    return {factor: true_maps(capture, factor) for factor in (1, 4)}


@pytest.fixture(scope="module")
def workspaces(room, maps, tmp_path_factory):
    """By the same factors."""
    root = tmp_path_factory.mktemp("dense")
    return {f: write_dense_workspace(room, maps[f], root / f"{f}").path for f in (1, 4)}


def _mat(path):
    """A map as COLMAP's Mat<float>::Read and Get(row, col, slice) take it, [H, W, C]."""
    width, height, depth, body = path.read_bytes().split(b"&", 3)
    values = np.frombuffer(body, "<f4").reshape(int(depth), int(height), int(width))
    return np.moveaxis(values, 0, -1)


def _fused_points(workspace, image):
    """World points and normals of a map's pixels, as COLMAP's StereoFusion places them."""
    depth = _mat(workspace / f"stereo/depth_maps/{image.name}.geometric.bin")[..., 0]
    normal = _mat(workspace / f"stereo/normal_maps/{image.name}.geometric.bin")
    height, width = depth.shape
    scale = np.array([width / image.camera.width, height / image.camera.height, 1])
    camera = Camera(np.diag(scale) @ image.camera.K, width, height, image.camera.cam_from_world)
    rows, columns = np.nonzero(depth > 0)
    xyz = camera.unproject(np.stack([columns, rows], axis=1), depth[rows, columns])
    return xyz, normal[rows, columns] @ camera.cam_from_world[:3, :3]


@pytest.mark.parametrize("factor", [1, 4])
def test_pixels_lie_on_the_surface_where_colmap_places_them(factor, capture, maps, workspaces):
    scene = load_scene(workspaces[factor])
    ids = [image.image_id for image in scene.images]
    assert ids == sorted(ids)  # COLMAP 3 counts in file order, COLMAP 4 by id
    truth = maps[factor][2]
    graph = workspaces[factor] / f"stereo/consistency_graphs/{truth.name}.geometric.bin"
    body = graph.read_bytes().split(b"&", 3)[3]
    column, row, num, *rest = np.frombuffer(body, "<i4").tolist()
    expected = [n for k, n in enumerate(truth.sources) if truth.agreeing[row, column] >> k & 1]
    assert [scene.images[idx].name for idx in rest[:num]] == expected
    for image in scene.images[:3]:
        xyz, normal = _fused_points(workspaces[factor], image)
        assert len(xyz) > 0.8 * (97 // factor) * (73 // factor)
        away = np.abs(capture.surfaces.distance(xyz))
        assert np.quantile(away, FLAT) < ON_SURFACE
        assert np.quantile(away, 0.95) < PIXEL * factor
        np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-5)
        assert (np.einsum("ij,ij->i", normal, xyz - image.camera.center) < 0).all()
        stored = find_depths(scene, workspaces[factor]).read(image.name)  # at pixel centres
        rows, columns = np.nonzero(np.isfinite(stored.values))
        uv = np.stack([columns, rows], axis=1) + 0.5
        xyz = stored.camera(image.camera).unproject(uv, stored.values[rows, columns])
        assert np.quantile(np.abs(capture.surfaces.distance(xyz)), FLAT) < ON_SURFACE


def test_pycolmap_fuses_it(capture, workspaces, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="needs splatseed[sfm]")
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels = 3
    fused = tmp_path / "fused.ply"
    pycolmap.stereo_fusion(fused, workspaces[4], options=options, output_type="ply")
    points = read_ply(fused)
    assert len(points) > 125
    away = np.abs(capture.surfaces.distance(points.xyz.astype(np.float64)))
    assert np.median(away) < 2 * ON_SURFACE  # 0.3 pixels without the move to COLMAP's rays
    assert np.quantile(away, 0.95) < PIXEL * 2


def test_distorted_photographs_come_without_their_distortion(capture, room, maps, tmp_path):
    bent_room = load_scene(write_capture(bend(capture), tmp_path / "room"))
    mixed = bent_room.replace(images=(*bent_room.images[:6], *room.images[6:]))
    write_dense_workspace(mixed, maps[4], tmp_path / "w", undistort=undistort)
    scene = load_scene(tmp_path / "w")
    assert {lens.model for lens in scene.intrinsics} == {"PINHOLE"}
    links = [(tmp_path / "w/images" / image.name).is_symlink() for image in mixed.images]
    assert links == [False] * 6 + [True] * 2
    for straight, lens, image in zip(room.images, bent_room.images, scene.images[:6], strict=False):
        np.testing.assert_allclose(image.camera.K, straight.camera.K)
        np.testing.assert_allclose(image.observations.xy, straight.observations.xy, atol=1e-6)
        undistorted, bent, truth = (
            np.asarray(PilImage.open(each.source.image_dir / image.name).convert("RGB"))
            for each in (scene, bent_room, room)
        )
        expected, _ = undistort(bent, lens.intrinsics, image.camera.K)
        np.testing.assert_array_equal(undistorted, expected)
        error, before = (np.abs(each.astype(int) - truth).mean() for each in (undistorted, bent))
        assert error < 0.8 * before  # two interpolations blur


def test_cameras_are_those_of_reduced_photographs_and_points_stand_in_for_tracks(
    capture, maps, tmp_path
):
    path = write_capture(capture, tmp_path / "room")
    for picture in (path / "images").iterdir():
        with PilImage.open(picture) as image:
            half = image.resize((48, 36))
        half.save(picture)
    scene = load_scene(path)
    assert write_dense_workspace(scene, maps[4][:2], tmp_path / "w").num_maps == 2
    small = load_scene(tmp_path / "w")
    assert {(camera.width, camera.height) for camera in small.intrinsics} == {(48, 36)}
    expected = scene.images[0].observations.xy * [48 / 97, 36 / 73]
    np.testing.assert_allclose(small.images[0].observations.xy, expected)
    xyz, _ = _fused_points(tmp_path / "w", small.images[0])
    assert np.median(np.abs(capture.surfaces.distance(xyz))) < ON_SURFACE
    assert (tmp_path / "w/stereo/fusion.cfg").read_text().count("\n") == 2
    write_dense_workspace(scene.replace(tracks=None), maps[4][:2], tmp_path / "no tracks")
    model = load_scene(tmp_path / "no tracks")
    assert 200 <= len(model.points) <= 400
    assert np.median(np.abs(capture.surfaces.distance(model.tracks.xyz))) < ON_SURFACE
    for image in model.images:
        ids = image.observations.point_ids
        uv, _ = image.camera.project(model.tracks.xyz[ids - 1])
        np.testing.assert_allclose(image.observations.xy, np.nan_to_num(uv), atol=1e-6)
        mine = model.tracks.image_ids == image.image_id
        owner = np.repeat(model.tracks.point_ids, model.tracks.lengths)[mine]
        np.testing.assert_array_equal(ids[model.tracks.point2d_idx[mine]], owner)


def test_plain_maps_have_the_rest_beside_them(room, maps, tmp_path):
    report = write_dense_maps(room, iter(maps[4]), tmp_path / "plain")
    known = sum(int(np.isfinite(each.depth).sum()) for each in maps[4])
    assert (report.num_maps, report.num_known) == (8, known)
    assert len(find_depths(room, tmp_path / "plain")) == 8
    first = maps[4][0]
    rest = np.load(tmp_path / "plain" / f"{first.name}.stereo.npz", allow_pickle=False)
    np.testing.assert_array_equal(rest["normal"], first.normal)
    np.testing.assert_array_equal(rest["agreeing"], first.agreeing)
    assert tuple(rest["sources"]) == first.sources


@pytest.mark.parametrize("write", [write_dense_workspace, write_dense_maps])
def test_maps_that_do_not_belong_are_refused(write, maps, room, tmp_path):
    first = maps[4][0]
    turned = replace(first.camera, cam_from_world=first.camera.cam_from_world[[1, 0, 2, 3]])
    for changes, said in (
        ([], "at least one depth map"),
        ([{}, {}], "one depth map per image"),
        ([{"name": "other.png"}], "images of the scene"),
        ([{"sources": ("other.png",)}], "images of the scene"),
        ([{"sources": ("view_001.png",) * 9}], "at most 8 sources"),
        ([{"depth": np.ones((3, 3))}], "arrays of its camera's size"),
        ([{"camera": turned}], "the pose of its image"),
    ):
        with pytest.raises(InputError, match=said):
            write(room, (replace(first, **each) for each in changes), tmp_path / "w")
        assert list(tmp_path.iterdir()) == []


def test_scenes_that_cannot_be_fused_are_refused(maps, room, tmp_path):
    lens = room.images[0].intrinsics
    bent = replace(lens, model="SIMPLE_RADIAL", params=(100.0, 60.0, 45.0, 0.1))
    for error, said, changes in (
        (SceneFormatError, "distortion", {"intrinsics": bent}),
        (OutputError, "inside their folder", {"name": "../view_000.png"}),
        (SceneNotFoundError, "gone.png", {"name": "gone.png"}),
    ):
        scene = room.replace(images=(replace(room.images[0], **changes), *room.images[1:]))
        with pytest.raises(error, match=said):
            write_dense_workspace(scene, maps[4][:1], tmp_path / "w")
    with pytest.raises(SceneNotFoundError, match="photographs"):
        write_dense_workspace(room.replace(source=SceneSource()), maps[4][:1], tmp_path / "w")
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=30, deadline=None)
@given(
    agreeing=hnp.arrays(np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=7)),
    image_idxs=st.lists(st.integers(0, 2**31 - 1), max_size=8),
)
def test_maps_and_graphs_against_the_loop(tmp_path_factory, agreeing, image_idxs):
    """A graph is literally as COLMAP's patch match lists it."""
    folder = tmp_path_factory.mktemp("graph")
    write_consistency_graph(folder / "a.bin", agreeing, image_idxs)
    records = []
    for row, column in np.ndindex(*agreeing.shape):
        confirming = [idx for k, idx in enumerate(image_idxs) if agreeing[row, column] >> k & 1]
        if confirming:
            records += [column, row, len(confirming), *confirming]
    height, width = agreeing.shape
    head = f"{width}&{height}&1&".encode()
    assert (folder / "a.bin").read_bytes() == head + np.array(records, "<i4").tobytes()
    depth = np.where(agreeing > 200, np.nan, agreeing).astype(np.float32)
    write_map(folder / "sub/b.bin", depth)
    assert (folder / "sub/b.bin").read_bytes() == head + np.nan_to_num(depth).tobytes()


def test_a_plane_seen_edge_on_is_left_out_and_one_without_normal_stays(maps):
    dense = maps[4][0]
    K, shape = dense.camera.K, dense.normal.shape
    np.testing.assert_array_equal(depth_along(dense, K, 0.5), dense.depth)
    edge_on = replace(dense, normal=np.broadcast_to(np.float32([1, 0, -0.02]), shape))
    left_out = np.isnan(depth_along(edge_on, K, 0.0)) & np.isfinite(dense.depth)
    assert 0 < left_out.sum() < left_out.size / 2
    unknown = replace(dense, normal=np.full(shape, np.nan, np.float32))
    np.testing.assert_array_equal(depth_along(unknown, K, 0.0), dense.depth)
