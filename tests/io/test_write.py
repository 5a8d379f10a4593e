"""What is written is what was read plus the new points, whole, consistent, and beside the input."""

from __future__ import annotations

import errno
import json
import shutil
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from splatseed.errors import OutputError, PointCloudError
from splatseed.io import colmap, load_scene, write_scene
from splatseed.io.ply import read_ply, write_ply
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.tracks import Observations

from ..findings import texts

pycolmap = pytest.importorskip("pycolmap")


def more_points(scene, rng, count=25):
    new = PointCloud(
        rng.normal(size=(count, 3)),
        rng.integers(0, 256, (count, 3)).astype(np.uint8),
        np.full(count, 3, np.uint8),
    )
    return scene.replace(points=PointCloud.concatenate(scene.points, new))


def check_consistent(folder, scene, num_points):
    """Pycolmap opens the model; ids are contiguous; both sides of every observation agree."""
    reconstruction = pycolmap.Reconstruction(str(folder / "sparse/0"))
    assert sorted(reconstruction.points3D) == list(range(1, num_points + 1))
    assert len(reconstruction.images) == len(scene.images)
    points, tracks = colmap.read_points3d(folder / "sparse/0/points3D.bin")
    images = load_scene(folder).images
    observed = {im.image_id: im.observations.point_ids for im in images}
    owner = np.repeat(tracks.point_ids, tracks.lengths)
    for image_id, ids in observed.items():
        mine = tracks.image_ids == image_id
        np.testing.assert_array_equal(ids[tracks.point2d_idx[mine]], owner[mine])
    assert sum(np.count_nonzero(ids != -1) for ids in observed.values()) == len(owner)
    cloud = read_ply(folder / "sparse/0/points3D.ply")
    np.testing.assert_array_equal(cloud.xyz, points.xyz)
    np.testing.assert_array_equal(cloud.rgb, points.rgb)
    return tracks


def test_originals_keep_everything_but_their_ids(scene_dir, tmp_path, rng, model):
    scene = more_points(load_scene(scene_dir), rng)
    given = {"method": "mls", "seed": np.int64(3), "options": {"k": 16}, "path": Path("a")}
    report = write_scene(scene, tmp_path / "out", provenance=given)
    assert (report.num_points, report.num_original) == (35, 10)
    told = json.loads((tmp_path / "out/splatseed.json").read_text())
    assert told["source"] == str(scene_dir)
    assert (told["method"], told["seed"], told["options"]) == ("mls", 3, {"k": 16})
    assert (told["num_points"], told["num_original"], told["num_new"]) == (35, 10, 25)
    assert set(told["versions"]) == {"python", "splatseed", "numpy", "scipy", "numba"}
    listed = {p.relative_to(report.path).as_posix() for p in report.path.rglob("*.[bjnp]*")}
    assert {n for n in listed if not n.startswith("images")} == set(report.files) - {"images"}
    with pytest.raises(OutputError, match="apart from the input"):
        write_scene(scene, scene_dir / "out", overwrite=True)
    tracks = check_consistent(tmp_path / "out", scene, 35)
    np.testing.assert_array_equal(tracks.xyz[:10], model.tracks.xyz)
    np.testing.assert_array_equal(tracks.errors, [*model.tracks.errors, *[-1] * 25])
    np.testing.assert_array_equal(tracks.offsets, np.append(model.tracks.offsets, [40] * 25))
    np.testing.assert_array_equal(tracks.image_ids, model.tracks.image_ids)
    np.testing.assert_array_equal(tracks.point2d_idx, model.tracks.point2d_idx)
    np.testing.assert_array_equal(tracks.xyz[10:].astype(np.float32), scene.points.xyz[10:])
    new_of_old = dict(zip(model.tracks.point_ids.tolist(), range(1, 11), strict=True)) | {-1: -1}
    for ours, theirs in zip(load_scene(tmp_path / "out").images, scene.images, strict=True):
        expected = [new_of_old[i] for i in theirs.observations.point_ids.tolist()]
        assert ours.observations.point_ids.tolist() == expected
        np.testing.assert_array_equal(ours.observations.xy, theirs.observations.xy)
    moved = scene.replace(points=scene.points.replace(xyz=scene.points.xyz + 1))
    write_scene(moved, tmp_path / "moved")
    assert not check_consistent(tmp_path / "moved", moved, 35).lengths.any()


def test_contiguous_ids_are_written_back_byte_for_byte(scene_dir, tmp_path, rng):
    first = write_scene(load_scene(scene_dir), tmp_path / "a").path / "sparse/0"
    more = write_scene(more_points(load_scene(tmp_path / "a"), rng), tmp_path / "b").path
    for name, start in (("cameras.bin", 0), ("images.bin", 0), ("points3D.bin", 8)):
        written = (more / "sparse/0" / name).read_bytes()[start:]
        assert written.startswith((first / name).read_bytes()[start:])


def test_unusable_points_are_dropped_with_their_observations(scene_dir, tmp_path, model, rng):
    xyz = model.tracks.xyz.copy()
    xyz[2], xyz[5], xyz[7] = np.nan, xyz[1], np.inf
    broken = replace(model.tracks, xyz=xyz)
    points = PointCloud(xyz, model.points.rgb)
    colmap.write_points3d(scene_dir / "sparse/0/points3D.bin", points, broken)
    scene = more_points(load_scene(scene_dir), rng, 3)
    again = PointCloud.concatenate(scene.points, scene.points.select(np.array([7, 0])))
    report = write_scene(scene.replace(points=again), tmp_path / "out")
    assert (report.dropped_nonfinite, report.dropped_duplicates) == (2, 3)
    assert (report.num_points, report.num_original) == (10, 7)
    assert report.findings == ()
    tracks = check_consistent(tmp_path / "out", scene, 10)
    np.testing.assert_array_equal(tracks.xyz[:7], xyz[[0, 1, 3, 4, 6, 8, 9]])


def test_references_that_nobody_confirms_are_taken_out(scene_dir, tmp_path, model):
    scene = load_scene(scene_dir)
    tracks = scene.tracks
    image_ids, point2d_idx = tracks.image_ids.copy(), tracks.point2d_idx.copy()
    image_ids[0], point2d_idx[5] = 99, 5000  # no such image, no such feature
    observed = scene.images[2].observations
    point_ids = observed.point_ids.copy()
    point_ids[np.flatnonzero(point_ids == -1)[0]] = 777  # no such point
    odd = replace(scene.images[2], observations=Observations(observed.xy, point_ids))
    scene = scene.replace(
        images=(*scene.images[:2], odd, scene.images[3]),
        tracks=replace(tracks, image_ids=image_ids, point2d_idx=point2d_idx),
    )
    report = write_scene(scene, tmp_path / "out")
    written = check_consistent(tmp_path / "out", scene, 10)
    assert written.lengths.sum() == model.tracks.lengths.sum() - 2
    assert "references" in " ".join(texts(report))


@pytest.mark.parametrize("lost", ["image", "camera", "unused camera"])
def test_rigs_and_frames_go_with_a_record_that_is_left_out(scene_dir, tmp_path, lost):
    """Or else pycolmap could not use, or not even read, what is written."""
    folder = scene_dir / "sparse/0"
    model = pycolmap.Reconstruction(str(folder))
    nan = float("nan")
    if "camera" in lost:  # of a rig without images
        focal = nan if lost == "camera" else 50
        spare = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[focal, 50, 32, 24])
        spare.camera_id = 1 + max(model.cameras)
        model.add_camera_with_trivial_rig(spare)
    if lost == "image":
        frame = model.frames[min(model.frames)]
        frame.rig_from_world = pycolmap.Rigid3d(frame.rig_from_world.rotation, [nan] * 3)
    model.write_binary(str(folder))
    scene = load_scene(scene_dir)
    if lost == "unused camera":
        scene = scene.replace(intrinsics=())
    report = write_scene(scene, tmp_path / "out")
    assert "Rigs" in " ".join(texts(report))
    written = pycolmap.Reconstruction(str(tmp_path / "out/sparse/0"))
    assert len(written.images) == len(scene.images) == len(model.images) - (lost == "image")
    assert f"num_images = {len(scene.images)}" in written.summary()


def test_rigs_and_frames_are_copied_byte_for_byte(scene_dir, tmp_path, rng):
    folder = scene_dir / "sparse/0"
    pycolmap.Reconstruction(str(folder)).write(str(folder))
    assert (folder / "frames.bin").is_file()
    (scene_dir / "poses_bounds.npy").write_bytes(b"bounds")
    (folder / "depth_params.json").write_text("{}")
    scene = more_points(load_scene(scene_dir), rng)
    write_scene(scene, tmp_path / "out")
    for name in ("rigs.bin", "frames.bin", "depth_params.json", "../../poses_bounds.npy"):
        assert (tmp_path / "out/sparse/0" / name).read_bytes() == (folder / name).read_bytes()
    check_consistent(tmp_path / "out", scene, 35)
    other = replace(scene.images[0], name="other.jpg")
    # Frames hold poses, too: those of before would contradict refined ones.
    moved = replace(scene.images[0], translation=scene.images[0].translation + 1e-3)
    for i, changed in enumerate(((), (other,), (moved,))):
        images = (*changed, *scene.images[1:])
        report = write_scene(scene.replace(images=images), tmp_path / f"{i}")
        assert "Rigs" in " ".join(texts(report))
        assert not (tmp_path / f"{i}/sparse/0/frames.bin").exists()
        pycolmap.Reconstruction(str(tmp_path / f"{i}/sparse/0"))
    pycolmap.Reconstruction(str(folder)).write_text(str(folder))
    for path in folder.glob("*.bin"):
        path.unlink()
    report = write_scene(load_scene(scene_dir), tmp_path / "text")
    assert "as text" in " ".join(texts(report))
    assert not list((tmp_path / "text/sparse/0").glob("*.txt"))


def test_scene_without_images_opens_and_says_what_to_do_with_it(scene_dir, tmp_path, model):
    (scene_dir / "sparse/0/images.bin").unlink()
    write_ply(tmp_path / "cloud.ply", model.points)
    bare = load_scene(tmp_path / "cloud.ply")
    for name, scene in (("a", load_scene(scene_dir)), ("b", bare)):
        report = write_scene(scene, tmp_path / name)
        assert "full scene" in " ".join(texts(report))
        assert len(pycolmap.Reconstruction(str(report.path / "sparse/0")).points3D) == 10
    with pytest.raises(OutputError, match="needs images"):
        write_scene(bare, tmp_path / "json", format="transforms")
    with pytest.raises(OutputError, match="colmap or transforms"):
        write_scene(bare, tmp_path / "json", format="obj")
    nothing = model.points.replace(xyz=np.full((10, 3), np.nan))
    with pytest.raises(PointCloudError, match="none of them finite"):
        write_scene(Scene(nothing), tmp_path / "json")
    assert not (tmp_path / "json").exists()


def test_image_folders_are_linked(scene_dir, tmp_path, monkeypatch):
    for name in ("images_4", "masks", "other", "images_backup"):
        (scene_dir / name).mkdir()
    monkeypatch.chdir(scene_dir.parent)
    report = write_scene(load_scene("scene"), "out")
    out = tmp_path / "out"
    assert {"images", "images_4", "masks"} <= set(report.files)
    links = {path.name: str(path.readlink()) for path in out.iterdir() if path.is_symlink()}
    assert links == {name: f"../scene/{name}" for name in ("images", "images_4", "masks")}
    shutil.move(out, tmp_path / "elsewhere")
    assert not any("missing" in w for w in texts(load_scene(tmp_path / "elsewhere")))


@pytest.mark.parametrize("how", ["asked", "no links"])
def test_images_are_copied_when_asked_or_when_links_fail(scene_dir, tmp_path, monkeypatch, how):
    if how == "no links":
        refused = OSError(errno.EPERM, "Operation not permitted")
        monkeypatch.setattr(Path, "symlink_to", Mock(side_effect=refused))
    else:  # images in the root are taken without the rest
        (scene_dir / "images/left").rename(scene_dir / "left")
        (scene_dir / "images").rmdir()
        (scene_dir / "stale.ply").touch()
    for path in [*scene_dir.rglob("*"), scene_dir]:  # read-only input is no obstacle
        path.chmod(0o555 if path.is_dir() else 0o444)
    write_scene(load_scene(scene_dir), tmp_path / "out", copy_images=how == "asked")
    for path in [scene_dir, *scene_dir.rglob("*")]:
        path.chmod(0o755 if path.is_dir() else 0o644)
    shutil.rmtree(scene_dir)
    scene = load_scene(tmp_path / "out")
    assert not any("missing" in text for text in texts(scene))
    assert [path.name for path in (tmp_path / "out/images").iterdir()] == ["left"]
    assert not (tmp_path / "out/images").is_symlink()
