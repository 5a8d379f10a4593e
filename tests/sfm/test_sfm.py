"""Structure-from-Motion on views of the room, whose poses and surfaces are known."""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import PurePosixPath
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image as PilImage
from scipy.ndimage import gaussian_filter

from splatseed.camera import Intrinsics
from splatseed.errors import (
    MissingDependencyError,
    OutputError,
    ParameterError,
    ReconstructionError,
    SceneFormatError,
    SceneNotFoundError,
)
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.runtime import child
from splatseed.scene import Scene, Split
from splatseed.sfm import Settings, mapping, reconstruct
from splatseed.sfm.export import clear_orientation, drop_folded, drop_repeats
from splatseed.sfm.photos import EXCLUDED, find_photos
from splatseed.similarity import fit_similarity

pycolmap = pytest.importorskip("pycolmap")


@pytest.fixture(scope="module")
def posed(room):
    """Six neighbouring views of the room, without points."""
    return Scene(PointCloud.empty(), room.images[:6], room.intrinsics)


@pytest.fixture(scope="module")
def photos(posed, room, tmp_path_factory):
    """Their photographs."""
    folder = tmp_path_factory.mktemp("photos")
    for image in posed.images:
        shutil.copy(room.source.image_dir / image.name, folder)
    return folder


def files_below(folder):
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def test_reconstruct_finds_the_cameras(posed, photos, tmp_path):
    seen = {}
    report = reconstruct(
        photos,
        tmp_path / "scene",
        camera_model="SIMPLE_RADIAL",
        on_progress=lambda stage, done: seen.setdefault(stage, []).append(done),
    )

    assert (report.registered, report.total, report.unregistered) == (6, 6, ())
    assert files_below(report.path) == {
        *(f"images/{image.name}" for image in posed.images),
        *(f"sparse/0/{n}.bin" for n in ("cameras", "images", "points3D", "rigs", "frames")),
        *("distorted.json", "splatseed.json"),
    }
    model = pycolmap.Reconstruction(report.path / "sparse" / "0")
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    assert model.num_points3D() == report.num_points > 200
    assert model.compute_mean_track_length() == pytest.approx(report.mean_track_length)
    stored = np.mean([point.error for point in model.points3D.values()])
    assert stored == pytest.approx(report.mean_reprojection_error)
    assert stored < 1.0
    centers = np.array(
        [model.find_image_with_name(i.name).projection_center() for i in posed.images]
    )
    true = np.array([image.camera.center for image in posed.images])
    moved = fit_similarity(centers, true).points(centers)
    assert np.linalg.norm(moved - true, axis=1).max() < 0.05

    assert list(seen) == ["features", "matching", "mapping", "undistortion"] == list(report.seconds)
    assert {(fractions[0], fractions[-1]) for fractions in seen.values()} == {(0.0, 1.0)}
    manifest = json.loads((report.path / "splatseed.json").read_text())
    assert manifest["report"]["registered"] == 6


@pytest.mark.parametrize("has_exif", [True, False])
@pytest.mark.usefixtures("pycolmap_here")
def test_few_photographs_get_a_lens_without_distortion(posed, photos, tmp_path, has_exif):
    """With EXIF of 26 mm, which is 5% off, the focal length is its; else it is estimated."""
    few = tmp_path / "few"
    few.mkdir()
    for image in posed.images[:5]:
        picture, exif = PilImage.open(photos / image.name), PilImage.Exif()
        if has_exif:
            exif.get_ifd(0x8769)[0xA405] = 26  # FocalLengthIn35mmFilm
        picture.save(few / PurePosixPath(image.name).with_suffix(".jpg"), exif=exif, quality=98)
    report = reconstruct(few, tmp_path / "scene")
    assert report.registered == 5
    (found,) = report.findings
    assert (found.kind, "EXIF" in found.text) == ("held-lens", has_exif)
    lens = load_scene(report.path).images[0].intrinsics
    assert (lens.model, lens.width, lens.height) == ("SIMPLE_PINHOLE", 256, 192)  # nothing was cut
    guess = pycolmap.infer_camera_from_image(few / "view_000.jpg")
    assert guess.has_prior_focal_length is has_exif
    true = posed.images[0].K[0, 0]
    assert lens.pinhole.params[0] == (
        guess.focal_length if has_exif else pytest.approx(true, rel=0.03)
    )


@pytest.mark.usefixtures("pycolmap_here")
def test_known_poses_are_kept_and_surfaces_found(capture, posed, photos, tmp_path):
    known = posed.replace(images=posed.images[1:])  # the first photograph has no pose
    test = frozenset(["view_002.png"])
    split = Split(frozenset(image.name for image in known.images) - test, test, "two files")
    known = known.replace(listed=split)
    report = reconstruct(photos, tmp_path / "scene", Settings("sequential"), poses_from=known)
    again = load_scene(report.path).listed
    assert (again.train, again.test) == (split.train, split.test)

    assert (report.registered, report.total, report.unregistered) == (5, 6, ("view_000.png",))
    model = pycolmap.Reconstruction(report.path / "sparse" / "0")
    for image in known.images:
        pose = model.find_image_with_name(image.name).cam_from_world().matrix()
        np.testing.assert_allclose(pose, image.camera.cam_from_world[:3], atol=1e-12)
        copy = report.path / "images" / image.name
        assert copy.read_bytes() == (photos / image.name).read_bytes()
    (camera,) = model.cameras.values()
    assert tuple(camera.params) == posed.intrinsics[0].params
    xyz = np.array([point.xyz for point in model.points3D.values()])
    assert len(xyz) > 200
    assert np.median(capture.surfaces.distance(xyz)) < 0.01


@pytest.mark.usefixtures("pycolmap_here")
def test_a_known_lens_is_believed_and_triangulation_repeats_itself(posed, photos, tmp_path):
    """Coefficients above 1, as a Kinect's, which COLMAP takes for a calibration gone wrong."""
    cancel = (0.0, 0.0, 0.0, 0.0, 1.2, 0.0, 0.0, 1.2)  # the rational model's k3 = k6
    lens = Intrinsics(7, "FULL_OPENCV", 256, 192, (*posed.intrinsics[0].params, *cancel))
    images = tuple(replace(image, intrinsics=lens) for image in posed.images[:4])
    scene = Scene(PointCloud.empty(), images, (lens,))
    settings = Settings(seed=3, max_image_size=192)
    first, second = (
        reconstruct(photos, tmp_path / name, settings, poses_from=scene)
        for name in ("first", "second")
    )
    assert first.num_points > 50
    assert first.mean_reprojection_error < 1
    model = pycolmap.Reconstruction(first.path / "sparse" / "0")
    assert {camera.model.name for camera in model.cameras.values()} == {"PINHOLE"}
    for name in files_below(first.path) - {"splatseed.json"}:
        assert (first.path / name).read_bytes() == (second.path / name).read_bytes(), name


@pytest.mark.parametrize("num", [8, 3])
@pytest.mark.usefixtures("pycolmap_here")
def test_too_few_registered_is_an_error_that_names_them(num, photos, tmp_path, monkeypatch):
    """Fewer than half, or none; the work is kept for the next call, COLMAP's own log is not."""
    mixed = tmp_path / "mixed"
    if num == 8:
        shutil.copytree(photos, mixed)
    for folder in (mixed, tmp_path / "temporary"):
        folder.mkdir(exist_ok=True)
    for i in range(num):
        noise = gaussian_filter(np.random.default_rng(i).normal(128, 200, (120, 160)), 2)
        PilImage.fromarray(noise.clip(0, 255).astype(np.uint8)).save(mixed / f"other{i}.png")
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    how = {"camera_model": "SIMPLE_RADIAL", "shared_camera": False}
    with pytest.raises(ReconstructionError) as caught:
        reconstruct(mixed, tmp_path / "scene", **how)
    assert f"kept in {tmp_path / 'scene_sfm'}" in caught.value.fix
    assert "exhaustive" not in caught.value.fix  # it was
    assert "SIMPLE_RADIAL" not in caught.value.fix
    assert {path.name for path in tmp_path.iterdir()} == {"mixed", "temporary", "scene_sfm"}
    if num == 8:
        assert "6 in the largest" in caught.value.found
        assert "other0.png" in caught.value.found
        assert "view_000.png" not in caught.value.found
        assert "`partial=True`" in caught.value.fix
        notes = []
        report = reconstruct(mixed, tmp_path / "scene", **how, partial=True, note=notes.append)
        assert (report.registered, len(report.unregistered)) == (6, 8)
        assert "mapping" not in report.seconds  # its models were kept
        assert [each.kind for each in notes] == ["resumed-work"]
        assert len(load_scene(report.path).images) == 6
        assert {path.name for path in tmp_path.iterdir()} == {"mixed", "temporary", "scene"}
    assert not list((tmp_path / "temporary").iterdir())


@pytest.mark.parametrize(("pairs", "advised"), [(3, False), (2, True)])
def test_all_pairs_are_advised_only_if_some_are_left(pairs, advised, tmp_path, monkeypatch):
    monkeypatch.setattr(mapping, "_mapped", lambda *_: {})
    run = SimpleNamespace(
        kept=None, work=tmp_path, settings=Settings("auto"), num_pairs=lambda: pairs
    )
    with pytest.raises(ReconstructionError) as caught:
        mapping.map_images(run, ["a.png", "b.png", "c.png"], "OPENCV", bool, partial=False)
    assert ("matcher='exhaustive'" in caught.value.fix) == advised


def test_photographs_are_told_first_and_an_interrupt_leaves_nothing(photos, tmp_path):
    folder, told = tmp_path / "photos", []
    shutil.copytree(photos, folder / "below")
    PilImage.new("I;16", (256, 192)).save(folder / "depth.png")
    PilImage.new("L", (64, 48)).save(folder / "conf_00000.png")
    (folder / "phone.heic").touch()

    def interrupt(stage, _):
        if stage == "features":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(
            folder,
            tmp_path / "scene",
            on_progress=interrupt,
            on_photos=lambda names, left_out, _: told.append((names[0], *left_out.values())),
        )
    assert told == [("below/view_000.png", ["depth.png"], ["conf_00000.png"], ["phone.heic"])]
    assert {path.name for path in tmp_path.iterdir()} == {"photos", "scene_sfm"}


def test_reduced_copies_are_no_photographs(photos, tmp_path):
    for folder in ("images", "images_2", "images_4_png", "images_8x", "b/images", "b/images_8"):
        (tmp_path / folder).mkdir(parents=True)
        for number in range(2):
            shutil.copy(photos / f"view_00{number}.png", tmp_path / folder)
    (tmp_path / "images_2/view_000.png").rename(tmp_path / "images_2/view_000.PNG")
    (tmp_path / "images_2/view_001.png").rename(tmp_path / "images_2/other.png")  # not a copy
    found, left_out = find_photos(tmp_path)
    folders = Counter(str(PurePosixPath(name).parent) for name in found)
    assert folders == {"images": 2, "images_2": 1, "images_8x": 2, "b/images": 2}
    (copies,) = left_out.values()
    assert len(copies) == 5


def test_photographs_to_leave_out_are_not_even_read(photos, tmp_path, splatseed):
    folder = tmp_path / "photos"
    folder.mkdir()
    for number in range(4):
        shutil.copy(photos / f"view_00{number}.png", folder)
    (folder / "bad_1.jpg").write_bytes(b"cut off")
    found, left_out = find_photos(folder, ["bad_*", "view_003"])
    assert [*found] == ["view_000.png", "view_001.png", "view_002.png"]
    assert left_out == {EXCLUDED: ["bad_1.jpg", "view_003.png"]}
    for pattern, said in (("view_*", "at least 2 photographs"), ("img*", "matches none of 5")):
        run = splatseed(
            "sfm", folder, "--exclude", pattern, "--exclude", "bad_1", "-o", tmp_path / "o"
        )
        assert run.code == 2
        assert said in run.err


def test_a_dying_process_is_one_clear_error(photos, tmp_path, monkeypatch):
    program = "import os; os.write(2, b'  what():  disk full'); os.abort()"
    monkeypatch.setattr(child, "_PROGRAM", program)
    with pytest.raises(ReconstructionError, match="SIGABRT: disk full"):
        reconstruct(photos, tmp_path / "scene")
    assert not list(tmp_path.iterdir())


def test_bad_folders_are_refused(photos, tmp_path):
    folder, out = tmp_path / "photos", tmp_path / "scene"

    def refused(*said, error=SceneNotFoundError):
        with pytest.raises(error) as caught:
            reconstruct(folder, out)
        assert all(text in str(caught.value) for text in (str(folder), *said))
        assert not out.exists()

    refused()  # it is not there
    folder.mkdir()
    refused()  # it is empty
    (folder / "a.heic").touch()
    (folder / "notes.txt").touch()
    shutil.copy(photos / "view_000.png", folder / "a.png")
    PilImage.new("I;16", (256, 192)).save(folder / "depth.png")
    refused("depth.png", "a.heic", "1 other")
    (folder / "b.png").write_bytes(b"not an image")
    refused("b.png", error=SceneFormatError)
    with PilImage.open(photos / "view_000.png") as image:
        image.save(folder / "b.jpg")
    (folder / "b.png").unlink()
    (folder / "b.jpg").write_bytes((folder / "b.jpg").read_bytes()[:-2000])
    refused("b.jpg", error=SceneFormatError)  # cut short
    (folder / "images").mkdir()
    (folder / "splatseed.json").write_text('{"command": "upsample"}')
    refused(str(folder / "images"))  # its pictures are no photographs


@pytest.mark.parametrize("endian", ["<", ">"])
def test_exif_orientation_is_cleared_and_pixels_are_kept(tmp_path, endian):
    pixels = np.random.default_rng(0).integers(0, 256, (64, 64), np.uint8)
    exif = PilImage.Exif()
    exif.endian = endian
    exif[0x0110], exif[0x0112] = "a camera", 6
    (tmp_path / "sub").mkdir()
    for name in ("turned.jpg", "sub/turned.JPG", "plain.jpg", "turned.tif"):
        extra = {} if name == "plain.jpg" else {"exif": exif}
        kind = "TIFF" if name == "turned.tif" else "JPEG"
        PilImage.fromarray(pixels).save(tmp_path / name, format=kind, **extra)
    (tmp_path / "turned.jpg").chmod(0o444)
    before = {name: (tmp_path / name).read_bytes() for name in files_below(tmp_path)}
    assert clear_orientation(tmp_path) == dict.fromkeys(before.keys() - {"plain.jpg"}, 6)
    for name, old in before.items():
        new = (tmp_path / name).read_bytes()
        changed = sum(a != b for a, b in zip(old, new, strict=True))
        assert changed == (0 if name == "plain.jpg" else 1)  # 6 becomes 1
        with PilImage.open(tmp_path / name) as image:
            tags = image.getexif()
            assert tags.get(0x0112, 1) == 1
            assert name == "plain.jpg" or tags[0x0110] == "a camera"


@pytest.mark.usefixtures("pycolmap_here")
def test_what_cannot_be_done_is_refused_and_nothing_written(posed, photos, tmp_path):
    wrong = {"matcher": "psychic", "device": "tpu", "max_image_size": 0, "seed": -1, "threads": 0}
    for name, value in wrong.items():
        with pytest.raises(ParameterError, match=name):
            Settings(**{name: value})
    out, first = tmp_path / "out" / "scene", posed.images[0]
    cut = Intrinsics(1, "PINHOLE", 160, 110, (152.0, 152.0, 80.0, 60.0))
    renamed = tuple(replace(image, name=f"x{image.name}") for image in posed.images)
    small = tuple(replace(image, intrinsics=cut) for image in posed.images)
    here = {"quat": first.quat, "translation": first.translation}
    same_place = tuple(replace(image, **here) for image in posed.images)
    (tmp_path / "mine.txt").write_text("keep")
    for output, options, error in (
        (out, {"camera_model": "POLAROID"}, ParameterError),
        (tmp_path, {"overwrite": True}, OutputError),
        (photos / "scene", {}, OutputError),
        (out, {"poses_from": posed.replace(images=renamed)}, SceneNotFoundError),
        (out, {"poses_from": posed.replace(images=())}, SceneNotFoundError),
        (out, {"poses_from": posed.replace(images=small)}, SceneFormatError),
        (out, {"poses_from": posed.replace(images=same_place)}, ReconstructionError),
    ):
        with pytest.raises(error):
            reconstruct(photos, output, **options)
    kept = {f"out/scene_sfm/{name}" for name in ("database.db", "splatseed.json")}
    assert files_below(tmp_path) == {"mine.txt", *kept}  # of the last, whose features are found
    assert len(files_below(photos)) == 6


@pytest.mark.usefixtures("pycolmap_here")
def test_pycolmap_is_asked_for(photos, tmp_path, monkeypatch):
    if not pycolmap.has_cuda:
        with pytest.raises(MissingDependencyError, match="built for the CPU"):
            reconstruct(photos, tmp_path / "scene", Settings(device="cuda"))
    monkeypatch.setattr("splatseed.requirements.find_spec", lambda _: None)
    with pytest.raises(MissingDependencyError, match=r"-m pip install .*'pycolmap>=4\.0'"):
        reconstruct(photos, tmp_path / "scene")


def test_of_points_at_one_place_the_longest_track_stays(room_path):
    model = pycolmap.Reconstruction(room_path / "sparse" / "0")
    before = model.point3D_ids()
    short, *_, long = sorted(before, key=lambda each: model.point3D(each).track.length())
    model.point3D(short).xyz = model.point3D(long).xyz
    drop_repeats(model)
    assert model.point3D_ids() == before - {short}
    seen = {p.point3D_id for image in model.images.values() for p in image.points2D}
    assert short not in seen


def test_points_that_a_lens_model_folds_into_a_photograph_go(room_path):
    model = pycolmap.Reconstruction(room_path / "sparse" / "0")
    before = model.point3D_ids()
    near, folded, *_, long = sorted(before, key=lambda i: model.point3D(i).track.length())
    model.point3D(near).xyz += [0.02, 0.0, 0.0]  # a pixel or two
    model.point3D(folded).xyz += [30.0, 0.0, 0.0]
    length = model.point3D(long).track.length()
    wrong = model.point3D(long).track.elements[1]
    model.image(wrong.image_id).point2D(wrong.point2D_idx).xy = [-500.0, 0.0]
    drop_folded(model)
    assert model.point3D_ids() == before - {folded}
    assert model.point3D(long).track.length() == length - 1
