"""COLMAP itself is the judge of what its formats say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatseed.io.colmap import binary as colmap_binary, text as colmap_text
from splatseed.pointcloud import PointCloud

pycolmap = pytest.importorskip("pycolmap")


def _write(folder, model):
    colmap_binary.write_cameras(folder / "cameras.bin", model.intrinsics)
    colmap_binary.write_images(folder / "images.bin", model.images)
    colmap_binary.write_points3d(folder / "points3D.bin", model.points, model.tracks)


def _read(form, suffix, folder):
    cameras = form.read_cameras(folder / f"cameras.{suffix}")
    images = form.read_images(folder / f"images.{suffix}", cameras)
    return cameras, images, *form.read_points3d(folder / f"points3D.{suffix}")


def _assert_cameras_agree(reconstruction, intrinsics):
    assert set(reconstruction.cameras) == {camera.camera_id for camera in intrinsics}
    for camera in intrinsics:
        theirs = reconstruction.cameras[camera.camera_id]
        assert (theirs.model.name, theirs.width, theirs.height) == (
            camera.model,
            camera.width,
            camera.height,
        )
        assert tuple(theirs.params) == camera.params


def _assert_images_agree(reconstruction, images):
    assert set(reconstruction.images) == {image.image_id for image in images}
    for image in images:
        theirs = reconstruction.images[image.image_id]
        assert (theirs.name, theirs.camera_id) == (image.name, image.intrinsics.camera_id)
        np.testing.assert_allclose(
            theirs.cam_from_world().matrix(), image.camera.cam_from_world[:3], atol=1e-12
        )
        observations = image.observations
        ids = [p.point3D_id if p.has_point3D() else -1 for p in theirs.points2D]
        assert ids == observations.point_ids.tolist()
        np.testing.assert_array_equal([p.xy for p in theirs.points2D], observations.xy)


def _assert_points_agree(reconstruction, points, tracks):
    assert set(reconstruction.points3D) == set(tracks.point_ids.tolist())
    for i, point_id in enumerate(tracks.point_ids.tolist()):
        theirs = reconstruction.points3D[point_id]
        np.testing.assert_array_equal(theirs.xyz, tracks.xyz[i])
        np.testing.assert_array_equal(theirs.color, points.rgb[i])
        assert theirs.error == tracks.errors[i]
        observed = slice(*tracks.offsets[i : i + 2])
        elements = [(e.image_id, e.point2D_idx) for e in theirs.track.elements]
        ours = zip(tracks.image_ids[observed], tracks.point2d_idx[observed], strict=True)
        assert elements == [(int(a), int(b)) for a, b in ours]


def test_pycolmap_reads_what_we_write(model, tmp_path):
    _write(tmp_path, model)
    reconstruction = pycolmap.Reconstruction(tmp_path)
    _assert_cameras_agree(reconstruction, model.intrinsics)
    _assert_images_agree(reconstruction, model.images)
    _assert_points_agree(reconstruction, model.points, model.tracks)


def test_pycolmap_takes_new_points_without_tracks(model, tmp_path):
    grown = PointCloud.concatenate(model.points, model.points)
    _write(tmp_path, model._replace(points=grown))
    reconstruction = pycolmap.Reconstruction(tmp_path)
    new = [p for p in reconstruction.points3D.values() if not p.track.length()]
    assert len(reconstruction.points3D) == 20
    assert len(new) == 10
    assert {p.error for p in new} == {pycolmap.Point3D().error}


def test_images_without_features_are_images(model, tmp_path):
    images = tuple(replace(image, observations=None) for image in model.images)
    _write(tmp_path, model._replace(images=images))
    colmap_binary.write_points3d(tmp_path / "points3D.bin", model.points, None)
    theirs = pycolmap.Reconstruction(tmp_path).images
    assert {image.name for image in theirs.values()} == {image.name for image in images}
    ours = colmap_binary.read_images(tmp_path / "images.bin", model.intrinsics)
    assert [len(image.observations) for image in ours] == [0] * 4


@pytest.mark.parametrize(("form", "suffix"), [(colmap_binary, "bin"), (colmap_text, "txt")])
def test_we_read_what_pycolmap_writes(form, suffix, model, tmp_path):
    _write(tmp_path, model)
    reconstruction = pycolmap.Reconstruction(tmp_path)
    out = tmp_path / "theirs"
    out.mkdir()
    (reconstruction.write_binary if suffix == "bin" else reconstruction.write_text)(out)
    cameras, images, points, tracks = _read(form, suffix, out)
    _assert_cameras_agree(reconstruction, cameras)
    _assert_images_agree(reconstruction, images)
    _assert_points_agree(reconstruction, points, tracks)


def test_both_forms_of_a_real_model_agree(scenes, tmp_path, assert_same_images, assert_same_points):
    reconstruction = pycolmap.Reconstruction(scenes / "fern" / "sparse" / "0")
    reconstruction.write_binary(tmp_path)
    reconstruction.write_text(tmp_path)
    cameras, images, *points = _read(colmap_binary, "bin", tmp_path)
    text_cameras, text_images, *text_points = _read(colmap_text, "txt", tmp_path)
    assert text_cameras == cameras
    assert_same_images(text_images, images)
    assert_same_points(text_points, points)
    _assert_points_agree(reconstruction, *points)
