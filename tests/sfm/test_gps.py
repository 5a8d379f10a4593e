"""The frame of a scene by GPS: EXIF's positions, and what they determine."""

from __future__ import annotations

import json
import math
import re
from pathlib import PurePosixPath

import numpy as np
import pytest
from PIL import Image as PilImage
from PIL.TiffImagePlugin import IFDRational
from scipy.spatial.transform import Rotation

from splatseed.io import load_scene
from splatseed.sfm import reconstruct
from splatseed.sfm.gps import GpsPosition, align_to_gps, read_gps
from splatseed.similarity import Similarity

pycolmap = pytest.importorskip("pycolmap")

A, F = 6378137.0, 1 / 298.257223563  # WGS84: half the equator's diameter, m, and the flattening
E2 = F * (2 - F)


def earth_centred(latitude, longitude, altitude):
    """Earth-centred coordinates, by the closed formula."""
    b, c = math.radians(latitude), math.radians(longitude)
    normal = A / math.sqrt(1 - E2 * math.sin(b) ** 2)
    ring = (normal + altitude) * math.cos(b)
    z = (normal * (1 - E2) + altitude) * math.sin(b)
    return np.array([ring * math.cos(c), ring * math.sin(c), z])


def geodetic(xyz):
    """Latitude, longitude and altitude, by iteration of the latitude."""
    ring = math.hypot(*xyz[:2])
    b = math.atan2(xyz[2], ring * (1 - E2))
    for _ in range(10):
        normal = A / math.sqrt(1 - E2 * math.sin(b) ** 2)
        b = math.atan2(xyz[2] + E2 * normal * math.sin(b), ring)
    altitude = ring / math.cos(b) - normal
    return math.degrees(b), math.degrees(math.atan2(xyz[1], xyz[0])), altitude


def axes(latitude, longitude):
    """East, north and up as rows, in earth-centred axes."""
    b, c = math.radians(latitude), math.radians(longitude)
    east = [-math.sin(c), math.cos(c), 0]
    north = [-math.sin(b) * math.cos(c), -math.sin(b) * math.sin(c), math.cos(b)]
    up = [math.cos(b) * math.cos(c), math.cos(b) * math.sin(c), math.sin(b)]
    return np.array([east, north, up])


def positions_of(enu, origin):
    """The GPS positions of points on the tangent plane of an origin."""
    at = earth_centred(*origin)
    return [geodetic(at + axes(*origin[:2]).T @ each) for each in enu]


def exif_of(latitude, longitude, altitude, **more):
    """EXIF with a position, to a ten thousandth of an arc second and a millimetre."""
    exif = PilImage.Exif()
    exif[0x010F] = "Maker"  # Pillow takes EXIF without any tag of its own for empty
    tags = exif.get_ifd(0x8825)
    for tag, angle, signs in ((1, latitude, "NS"), (3, longitude, "EW")):
        minutes, seconds = divmod(round(abs(angle) * 3600e4), 60e4)
        tags[tag] = signs[angle < 0]
        parts = (*divmod(int(minutes), 60), IFDRational(int(seconds), 10000))
        tags[tag + 1] = tuple(IFDRational(part) for part in parts)
    tags[5] = b"\1" if altitude < 0 else b"\0"
    tags[6] = IFDRational(round(abs(altitude) * 1000), 1000)
    tags.update({int(tag[1:]): value for tag, value in more.items()})
    for tag in [tag for tag, value in tags.items() if value is None]:
        del tags[tag]
    return exif


def written(exif, folder, suffix=".jpg"):
    """A file with this EXIF, as an opened image."""
    path = folder / f"photo{suffix}"
    PilImage.new("RGB", (8, 8)).save(path, exif=exif)
    return PilImage.open(path)


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("place", [(46.5196535, 6.6322734, 495.25), (-33.8567, -151.2153, -3.5)])
def test_positions_are_read_as_colmap_reads_them(place, suffix, tmp_path):
    exif = exif_of(*place, _31=IFDRational(9, 2))
    with written(exif, tmp_path, suffix) as image:
        found = read_gps(image)
    assert found == pytest.approx((*place, 4.5), abs=1e-7)
    if suffix == ".jpg":
        bitmap = pycolmap.Bitmap.read(tmp_path / "photo.jpg", True)
        theirs = bitmap.exif_latitude(), bitmap.exif_longitude(), bitmap.exif_altitude()
        assert found[:2] == pytest.approx(theirs[:2], abs=1e-9)
        assert abs(found.altitude) == pytest.approx(abs(theirs[2]))


@pytest.mark.parametrize(
    "tags",
    [{"_9": "V"}, {"_1": None}, {"_4": None}, {"_2": (91.0, 0.0, 0.0)},
     {"_2": (IFDRational(1, 0), 0.0, 0.0)}, {"_2": (0.0,) * 3, "_4": (0.0,) * 3}],
    ids=["void", "no reference", "no longitude", "beyond the pole", "not a number", "zeros"],
)  # fmt: skip
def test_what_is_no_position_is_none(tags, tmp_path):
    with written(exif_of(46.5, 6.6, 500.0, **tags), tmp_path) as image:
        assert read_gps(image) is None


def test_without_altitude_it_is_unknown(tmp_path):
    with written(exif_of(46.5, 6.6, 500.0, _6=None), tmp_path) as image:
        found = read_gps(image)
    assert found[:2] == pytest.approx((46.5, 6.6))
    assert math.isnan(found.altitude)
    assert math.isnan(found.error)


TURN = Rotation.from_rotvec([0.4, -2.0, 0.7]).as_matrix()
ORIGIN = (-33.8567, 151.2153, 58.0)


@pytest.mark.usefixtures("pycolmap_here")
def test_photographs_with_gps_give_a_metric_scene_with_north_and_up(room, tmp_path):
    enu_from_room = Similarity(20.0, TURN, np.array([3.0, -40.0, 7.0]))
    names = [PurePosixPath(im.name).with_suffix(".jpg").name for im in room.images]
    enu = enu_from_room.points(np.array([im.camera.center for im in room.images]))
    places = dict(zip(names, positions_of(enu, ORIGIN), strict=True))
    (tmp_path / "photos").mkdir()
    for image, (name, place) in zip(room.images, places.items(), strict=True):
        stale = (ORIGIN[0] + 0.01, *ORIGIN[1:])  # a kilometre north
        exif = exif_of(*(stale if name == names[3] else place))
        picture = PilImage.open(room.source.image_dir / image.name)
        picture.save(tmp_path / "photos" / name, exif=exif, quality=98)
    report = reconstruct(tmp_path / "photos", tmp_path / "scene", camera_model="SIMPLE_PINHOLE")
    frame = report.gps
    assert frame.num_photographs == report.registered - 1 == 11
    at, to_axes = (
        earth_centred(frame.latitude, frame.longitude, frame.altitude),
        axes(frame.latitude, frame.longitude),
    )
    assert np.linalg.norm(at - earth_centred(*ORIGIN)) < 100
    true = {name: to_axes @ (earth_centred(*place) - at) for name, place in places.items()}
    scene = load_scene(report.path)
    off = [np.linalg.norm(im.camera.center - true[im.name]) for im in scene.images]
    assert np.median(off) < 0.1  # 5 mm in the room
    assert max(off) < 0.4
    assert frame.residual == pytest.approx(np.median(off), abs=0.05)
    # Points lie on the walls, so they moved with the cameras.
    there = enu_from_room.inverse.points(
        np.array(
            [axes(*ORIGIN[:2]) @ (at + to_axes.T @ p - earth_centred(*ORIGIN)) for p in
             scene.points.xyz.astype(np.float64)]
        )
    )  # fmt: skip
    near = np.linalg.norm(there[:, None] - room.points.xyz[None, ::7], axis=2).min(axis=1)
    assert np.median(near) < 0.2
    (finding,) = [each for each in report.findings if each.kind == "gps-frame"]
    assert "By the GPS of 11 of 12 photographs" in finding.text
    assert f"{-frame.latitude:.6f} S, {frame.longitude:.6f} E" in finding.text
    assert finding.subjects == (names[3],)
    manifest = json.loads((report.path / "splatseed.json").read_text())
    assert manifest["report"]["gps"]["latitude"] == frame.latitude


def model_of(centers):
    """A pycolmap model whose images n0, n1, ... are at these centres, with a point at (1, 2, 3)."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=9, height=9, params=[9, 4, 4])
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    for number, center in enumerate(centers):
        image = pycolmap.Image(name=f"n{number}", image_id=number + 1, camera_id=1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(TURN), -TURN @ center)
        model.add_image_with_trivial_frame(image, pose)
    model.add_point3D(np.array([1.0, 2.0, 3.0]), pycolmap.Track(), np.zeros(3, np.uint8))
    return model


@pytest.fixture
def aligned(tmp_path):
    """Aligns cameras to GPS: (frame, finding, model)."""

    def align(centers, places):
        (tmp_path / "model").mkdir()
        model_of(centers).write(tmp_path / "model")
        named = {f"n{number}": GpsPosition(*place) for number, place in enumerate(places)}
        folder, frame, finding = align_to_gps(
            pycolmap, tmp_path / "model", tmp_path / "aligned", named
        )
        assert (folder == tmp_path / "model") is (frame is None)
        return frame, finding, pycolmap.Reconstruction(folder)

    return align


SHAPE = np.random.default_rng(4).standard_normal((24, 3)) * [1.0, 1.0, 0.3]
"""Places of cameras in a model's frame."""


def test_the_error_of_positions_shows_in_the_frames(aligned):
    metres = Similarity(30.0, TURN.T, np.array([5.0, 6.0, 7.0])).points(SHAPE)
    noisy = metres + np.random.default_rng(5).standard_normal(metres.shape)
    frame, _, model = aligned(SHAPE, positions_of(noisy, ORIGIN))
    assert frame.num_photographs == 24
    assert frame.residual == pytest.approx(1.54, rel=0.25)  # the median for 1 m along each axis
    # 1 m off at the mean square distance from the longest axis, as if there were ten cameras
    across = 30.0 * np.sqrt(np.linalg.eigvalsh(np.cov(SHAPE.T, bias=True))[:2].sum())
    assert frame.turn_error == pytest.approx(np.degrees(1 / across / np.sqrt(10)), rel=0.2)
    centers = np.array([model.image(i + 1).projection_center() for i in range(24)])
    scale = np.linalg.norm(np.ptp(centers, axis=0)) / np.linalg.norm(np.ptp(SHAPE @ TURN, axis=0))
    assert scale == pytest.approx(30.0, rel=0.03)
    # The map is linear, so the point moves as cameras do.
    moved = np.linalg.lstsq(np.column_stack([SHAPE, np.ones(24)]), centers, rcond=None)[0]
    np.testing.assert_allclose(model.point3D(1).xyz, [1, 2, 3, 1] @ moved, atol=1e-6)


@pytest.mark.parametrize(
    ("shape", "scale", "noise", "stated", "named"),
    [
        (SHAPE, 2.0, 3.0, math.nan, "too close together"),
        (SHAPE, 10.0, 0.01, 9.0, "err by 6.4 m"),
        (SHAPE * [1, 0.002, 0.002], 50.0, 0.5, math.nan, "nearly on a line"),
        (SHAPE * [1, 0, 0], 50.0, 0.0, math.nan, "on one line"),
        (SHAPE[:4], 50.0, 0.0, math.nan, "4 photographs .* 5 are needed"),
    ],
    ids=["near", "inexact", "almost a line", "a line", "few"],
)
def test_positions_that_do_not_determine_a_frame(aligned, shape, scale, noise, stated, named):
    metres = Similarity(scale, TURN.T, np.zeros(3)).points(shape)
    noisy = metres + noise * np.random.default_rng(6).standard_normal(metres.shape)
    places = [(*each, stated) for each in positions_of(noisy, ORIGIN)]
    frame, finding, model = aligned(shape, places)
    assert frame is None
    assert np.array_equal(model.point3D(1).xyz, [1, 2, 3])
    assert re.search(named, finding.text)


def test_photographs_in_fiji_are_on_both_sides_of_the_date_line(aligned):
    places = positions_of(50.0 * SHAPE @ TURN, (-16.8, 180.0, 5.0))
    assert {np.sign(each[1]) for each in places} == {-1, 1}
    frame, _, _ = aligned(SHAPE, places)
    assert frame.residual < 1e-3
    assert abs(frame.longitude) == pytest.approx(180, abs=1e-3)
