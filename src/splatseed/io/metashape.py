"""Agisoft Metashape (PhotoScan): cameras exported as XML, and a point cloud as PLY.

A camera's ``transform`` (row-major 4 x 4) is ``chunk_from_cam`` in OpenCV axes; the ``transform``
of its component, else of the chunk, is a similarity to the world of exported points: rotation
(row-major), translation and scale. A sensor's calibration counts pixels, ``cx`` and ``cy`` from the
image centre, with (0.5, 0.5) at the centre of the first pixel:

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p1 (r^2 + 2 x^2) + 2 p2 x y
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8) + p2 (r^2 + 2 y^2) + 2 p1 x y
    u = w / 2 + cx + x' (f + b1) + y' b2,    v = h / 2 + cy + y' f

so p1 and p2 are OpenCV's in reverse order. For fisheyes (x, y) is first scaled to the angle from
the axis. Source: appendix "Camera models" of Metashape's user manual.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.camera_records import Lens, brown, fisheye, format_error, panorama
from splatseed.io.files import read_bytes
from splatseed.io.photogrammetry import Export, Shot, begins_with, ignored, read_export, with_r8
from splatseed.io.photograph_checks import Size
from splatseed.scene import OPENCV, Scene
from splatseed.similarity import Similarity, similarity_of

_CONVENTION = f"each transform is chunk_from_cam, {OPENCV}"
_FISHEYES = frozenset({"fisheye", "equidistant_fisheye"})
_FALSE = frozenset({"false", "0"})
_Element = ET.Element


def find_metashape(folder: Path) -> list[Path]:
    """List Metashape's exports of cameras in a folder."""
    return begins_with(folder, "*.xml", b"<document", b"<chunk", b"<sensors")


def read_metashape(path: Path, root: Path) -> Scene:
    """Read the cameras that have a pose, and the points of a PLY file beside them."""
    return read_export(_read, path, root, "Metashape's cameras, as XML")


def _read(path: Path) -> Export:
    document = ET.fromstring(read_bytes(path))  # noqa: S314  (expat bounds entities)
    chunk = document.find("chunk")
    cameras = chunk.find("cameras") if chunk is not None else None
    if chunk is None or cameras is None:
        raise format_error("a chunk with cameras", f"{path}", "none")
    findings = list[Finding]()
    lenses: dict[str | None, tuple[Size, Lens]] = {}
    for sensor in chunk.iterfind("sensors/sensor"):
        if sensor.find("calibration") is not None or sensor.get("type") == "spherical":
            size, lens, found = _sensor(f"{path}, sensor {sensor.get('id')}", sensor)
            lenses[sensor.get("id")] = size, lens
            findings += found
    worlds = {each.get("id"): _world(path, each) for each in chunk.iterfind("components/component")}
    world = _world(path, chunk)
    shots, unposed, disabled = list[Shot](), list[str](), list[str]()
    for camera in cameras.iter("camera"):
        name, lens_of = camera.get("label") or "", lenses.get(camera.get("sensor_id"))
        where, pose = f"{path}, camera {name}", camera.find("transform")
        if camera.get("enabled") in _FALSE:
            disabled.append(name)
        elif pose is None or lens_of is None:
            unposed.append(name)
        else:
            to_world = worlds.get(camera.get("component_id")) or world
            size, lens = lens_of
            shots.append(Shot(where, name, size, _fixed(lens), _posed(where, pose, to_world)))
    return Export("metashape", path, shots, _CONVENTION, unposed, disabled, findings=findings)


def _fixed(lens: Lens) -> Callable[[Size], Lens]:
    return lambda _: lens


def _posed(where: str, pose: _Element, to_world: Similarity) -> Float64[np.ndarray, "3 4"]:
    chunk_from_cam = _numbers(where, pose, 16).reshape(4, 4)
    center = to_world.points(chunk_from_cam[None, :3, 3])[0]
    return np.column_stack([to_world.rotation @ chunk_from_cam[:3, :3], center])


def _world(path: Path, element: _Element) -> Similarity:
    """Return the similarity from the chunk's or component's own frame to the world."""
    where, transform = f"{path}, transform", element.find("transform")
    rotation, translation, scale = np.eye(3), np.zeros(3), 1.0
    if transform is not None:
        for part in transform:
            if part.tag == "rotation":
                rotation = _numbers(where, part, 9).reshape(3, 3)
            elif part.tag == "translation":
                translation = _numbers(where, part, 3)
            elif part.tag == "scale":
                scale = float(_numbers(where, part, 1)[0])
    world = similarity_of(np.column_stack([scale * rotation, translation]))
    if world is None:
        raise format_error("a rotation, a translation and a scale", where, "another matrix")
    return world


def _sensor(where: str, sensor: _Element) -> tuple[Size, Lens, list[Finding]]:
    calibrations = sensor.findall("calibration")
    adjusted = [each for each in calibrations if each.get("class") == "adjusted"]
    calibration = [*calibrations, *adjusted][-1] if calibrations else sensor
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise format_error("a resolution", where, "none")
    width, height = (int(float(resolution.get(key) or 0)) for key in ("width", "height"))
    kind = calibration.get("type") or sensor.get("type") or "frame"
    if "spherical" in {kind, sensor.get("type")}:
        return (width, height), panorama(width, height), []
    if kind != "frame" and kind not in _FISHEYES:
        raise SceneFormatError(
            f"a frame, fisheye or spherical type of sensor in {where}",
            found=kind,
            fix="In Metashape, undistort the photographs, and export those and their cameras.",
        )
    numbers = {part.tag: _numbers(where, part, 1)[0] for part in calibration if part.text and
               part.tag[:1] in "fckpb" and len(part.tag) <= 2}  # fmt: skip
    lens, findings = _lens((width, height), numbers, kind, where)
    return (width, height), lens, findings


def _lens(
    size: Size, numbers: Mapping[str, float], kind: str, where: str
) -> tuple[Lens, list[Finding]]:
    f, cx, cy, k1, k2, k3, k4, p1, p2, p3, p4, b1, b2 = (
        float(numbers.get(key, 0.0))
        for key in ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
    )
    focal, center = (f + b1, f), (size[0] / 2 + cx, size[1] / 2 + cy)
    findings, radius = list[Finding](), math.hypot(*size) / 2
    if b2:
        findings.append(ignored("The skew b2", abs(b2) * size[1] / 2 / f, where))
    if p3 or p4:
        r2 = (radius / f) ** 2
        moved = radius * math.sqrt(r2) * 3 * math.hypot(p1, p2) * abs(p3 * r2 + p4 * r2 * r2)
        findings.append(ignored("The change p3, p4 of tangential terms", moved, where))
    if kind in _FISHEYES:
        return fisheye(focal, center, (k1, k2, k3, k4), (p2, p1)), findings
    return with_r8(brown(focal, center, (k1, k2, k3), (p2, p1)), k4), findings


def _numbers(where: str, element: _Element, count: int) -> Float64[np.ndarray, " N"]:
    try:
        numbers = np.array([float(each) for each in (element.text or "").split()], np.float64)
    except ValueError:
        numbers = np.zeros(0)
    if len(numbers) != count:
        found = repr((element.text or "")[:80])
        raise format_error(f"{count} numbers as {element.tag}", where, found)
    return numbers
