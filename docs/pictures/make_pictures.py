"""Make the pictures of the documentation, all from the demo's made-up capture.

Notation: a *panel* is a labelled picture, uint8 [H, W, 3]; a picture of the documentation is a grid
of panels, given as rows. Promise: the same versions give the same pictures; nothing but the PNGs
beside this file is written.

Run it from anywhere: ``python docs/pictures/make_pictures.py`` (about half a minute).
"""

# ruff: noqa: INP001  (a script, not a package)

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, UInt8
from matplotlib import colormaps
from PIL import Image as PillowImage, ImageDraw, ImageFont
from scipy.ndimage import gaussian_filter

import splatseed as ss
from splatseed.depth.alignment import align_maps
from splatseed.io import find_depths
from splatseed.io.depth_maps import depth_folder
from splatseed.io.staging import atomic_file
from splatseed.methods import methods_for
from splatseed.photos.viewpoint import choose_camera, choose_image, look_at
from splatseed.photos.visibility import find_visibility
from splatseed.scene import Image
from splatseed.seeding.geometry_score import mean_spacing
from splatseed.synthetic import Capture, make_capture, write_capture
from splatseed.viewer.maps import preview_depth
from splatseed.viewer.points import render_points

HERE = Path(__file__).parent
RATIO = 8
GAP, LABEL, INK, PAPER = 10, 28, (20, 20, 20), (255, 255, 255)

Picture = UInt8[np.ndarray, "H W 3"]


class Panel(NamedTuple):
    """A picture and what it shows."""

    label: str
    picture: Picture


def main() -> None:
    """Make every picture."""
    capture = make_capture()
    with TemporaryDirectory() as folder:
        # Depth is lifted from files; all else is as in memory.
        scene = ss.load_scene(write_capture(capture, Path(folder) / "room"))
        scene = scene.replace(depths=find_depths(scene, Path(folder) / "room"))
        clouds = {n: ss.upsample(scene, n, ratio=RATIO, seed=0) for n in methods_for(scene)}
        draw_lifting(capture, scene, clouds["depth"])
    draw_overview(capture, clouds)
    draw_errors(capture, clouds)
    for name in methods_for(capture.scene):
        draw_method(capture.scene, name, clouds[name])
    draw_depth()


def draw_overview(capture: Capture, clouds: Mapping[str, ss.PointCloud]) -> None:
    """Every method in one grid."""
    width, originals = 350, capture.scene.points
    labelled = {f"originals, {len(originals):,}": originals}
    labelled |= {f"{name}, {len(cloud):,}": cloud for name, cloud in clouds.items()}
    panels = [Panel("photograph", photograph(capture, width))]
    panels += cloud_panels(labelled, choose_camera(capture.scene), width, point_size=1.0)
    write_grid([panels[:3], panels[3:6], panels[6:]], HERE / "methods.png", colors=64)


def draw_errors(capture: Capture, clouds: Mapping[str, ss.PointCloud]) -> None:
    """Every method's new points, coloured by their distance to the true surfaces."""
    originals = capture.scene.points
    h = mean_spacing(originals.xyz)
    colored = {}
    for name, cloud in clouds.items():
        new = cloud.select(slice(len(originals), None))
        distance = capture.surfaces.distance(new.xyz) / h
        colored[f"{name}: median {np.median(distance):.2g} h"] = new.replace(rgb=heat(distance))
    panels = cloud_panels(colored, choose_camera(capture.scene), 270, point_size=1.0)
    bar = np.tile(heat(np.linspace(0.0, 1.0, 270)), (14, 1, 1))
    ends = [Panel("distance to the surface: 0 ... 1 h", bar)]
    write_grid([panels[:4], panels[4:], ends], HERE / "errors.png", colors=48)


def draw_depth() -> None:
    """``splatseed info --depth --picture``, on depth that is blurred and bent as a network's is."""
    rng = np.random.default_rng(0)
    with TemporaryDirectory() as folder:
        room, maps = Path(folder, "room"), Path(folder, "maps")
        scene = ss.load_scene(write_capture(make_capture(num_views=12), room))
        depths = find_depths(scene, room / "depths")
        with depth_folder(maps, "inverse") as writer:
            for name in depths:
                writer.write(name, as_predicted(depths.read(name).values, rng))
        scene = scene.replace(depths=find_depths(scene, maps))
        preview_depth(scene, align_maps(scene), HERE / "depth_check.png")
    with PillowImage.open(HERE / "depth_check.png") as picture:
        smaller = picture.convert("RGB").reduce(2).quantize(200)
    smaller.save(HERE / "depth_check.png", optimize=True)


def as_predicted(
    z: Float32[np.ndarray, "H W"], rng: np.random.Generator
) -> Float32[np.ndarray, "H W"]:
    """Depth as a relative network has it: inverse, of any scale and shift, soft, and bent."""
    inverse = gaussian_filter(1 / np.nan_to_num(z, nan=np.inf), 2.0)
    bent = gaussian_filter(rng.normal(size=z.shape), 40.0)
    bent *= rng.uniform(0.02, 0.12) / np.abs(bent).max()
    return np.float32((inverse * (1 + bent) - rng.uniform(0, 0.1)) * rng.uniform(2, 9))


def draw_method(scene: ss.Scene, name: str, cloud: ss.PointCloud) -> None:
    """One method on part of the room, and on a few points to show its construction."""
    camera = part_of(choose_camera(scene), left=80, top=88, width=240, height=160)
    width = 420
    room = {"originals": scene.points, f"{name}, {RATIO}x": cloud}
    eyes = {
        "few originals (black), many new points, from above": np.array([0.0, -1e-3, 40.0]),
        "... from the side": np.array([0.0, -40.0, 0.0]),
    }
    shown = [Panel(label, construction(name, eye, width)) for label, eye in eyes.items()]
    rows = [cloud_panels(room, camera, width, point_size=2.6), shown]
    write_grid(rows, HERE / f"{name}.png", colors=64)


def draw_lifting(capture: Capture, scene: ss.Scene, cloud: ss.PointCloud) -> None:
    """Lifting: what an image gives, and the cloud of all images, as in the paper's figure 2."""
    width, camera = 350, choose_camera(scene)
    image = choose_image(scene)
    pixels = lifted_from(scene, image, cloud)
    depth = scene.depths.read(image.name).values
    nearness = np.nan_to_num(np.nanmin(depth) / depth)
    sizes = {"size": (width, camera.height * width // camera.width)}
    shown = PillowImage.fromarray(heat(nearness.ravel()).reshape(*depth.shape, 3))
    seen = [
        Panel("photograph", photograph(capture, width)),
        Panel("its depth, near to far", np.asarray(shown.resize(resample=0, **sizes))),
        Panel("lifted pixels (blue), SfM points (black)", pixels),
    ]
    paper = ss.upsample(scene, "depth", ratio=RATIO, seed=0, profile="paper")
    clouds = {
        f"SfM: {len(scene.points):,} points": scene.points,
        f"depth, paper: {RATIO}x": paper,
        f"depth, default: {RATIO}x": cloud,
    }
    rows = [seen, cloud_panels(clouds, camera, width, point_size=1.3)]
    write_grid(rows, HERE / "depth.png", colors=96)


def lifted_from(scene: ss.Scene, image: Image, cloud: ss.PointCloud) -> Picture:
    """Where in an image its SfM points are, and the centres of pixels that new points came from."""
    camera, width = image.camera, 350
    new = cloud.select(cloud.source != 0)
    uv, z = camera.project(new.xyz)
    inside = (z > 0) & ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)
    column, row = np.floor(np.where(inside[:, None], uv, 0.0)).astype(int).T
    centred = np.abs(uv - np.floor(uv) - 0.5).max(axis=1) < 2e-3
    own = inside & centred & (np.abs(scene.depths.read(image.name).values[row, column] - z) < 1e-2)
    sfm = find_visibility(scene).of(image).astype(np.float32)
    blue = new.select(own).replace(rgb=np.full((own.sum(), 3), (60, 130, 200), np.uint8))
    black = ss.PointCloud(sfm, np.zeros((len(sfm), 3), np.uint8))
    scale = width / camera.width
    layers = [
        render_points(each, camera, scale=scale, point_size=size)
        for each, size in ((blue, 2.0), (black, 2.0))
    ]
    return np.minimum(*layers)


def construction(name: str, eye: Float64[np.ndarray, " 3"], width: int) -> Picture:
    """Originals on a wave in black, the points that a method makes of them in blue."""
    seeds = ss.upsample(few_points(), name, ratio=60, seed=0)
    new = seeds.source != 0
    rgb = np.where(new[:, None], (60, 130, 200), (0, 0, 0)).astype(np.uint8)
    height, focal = width * 5 // 8, 3.4 * width
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    camera = ss.Camera(K, width, height, look_at(eye, np.zeros(3), np.array([0, 1e-3, 1.0])))
    layers = [
        render_points(seeds.replace(rgb=rgb).select(which), camera, point_size=size)
        for which, size in ((new, 1.6), (~new, 6.0))
    ]
    return np.minimum(*layers)


def few_points() -> ss.PointCloud:
    """A jittered grid of 70 points on a gentle wave."""
    rng = np.random.default_rng(4)
    u, v = np.meshgrid(np.arange(10.0), np.arange(7.0))
    u, v = (axis.ravel() + rng.uniform(-0.33, 0.33, axis.size) for axis in (u, v))
    xyz = np.stack([u - 4.5, v - 3.0, np.sin(0.7 * u)], axis=1)
    return ss.PointCloud(xyz, np.zeros((len(xyz), 3), np.uint8))


def part_of(camera: ss.Camera, *, left: int, top: int, width: int, height: int) -> ss.Camera:
    """The camera with its image cropped to a rectangle of pixels."""
    K = camera.K.copy()
    K[:2, 2] -= left, top
    return ss.Camera(K, width, height, camera.cam_from_world)


def photograph(capture: Capture, width: int) -> Picture:
    """The photograph that ``choose_camera`` looks through."""
    chosen = choose_image(capture.scene)
    place = next(i for i, image in enumerate(capture.scene.images) if image is chosen)
    photo = PillowImage.fromarray(capture.images[place])
    height = round(photo.height * width / photo.width)
    return np.asarray(photo.resize((width, height), PillowImage.Resampling.LANCZOS))


def heat(values: Float64[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
    """Colours of 0..1 in 12 steps, so that a palette can hold them."""
    steps = np.round(np.clip(values, 0.0, 1.0) * 11) / 11
    return np.asarray(colormaps["plasma"](steps, bytes=True)[:, :3])


def cloud_panels(
    clouds: Mapping[str, ss.PointCloud], camera: ss.Camera, width: int, *, point_size: float
) -> list[Panel]:
    """The clouds by label, from one camera."""
    scale = width / camera.width
    return [
        Panel(label, render_points(cloud, camera, scale=scale, point_size=point_size))
        for label, cloud in clouds.items()
    ]


def write_grid(rows: Sequence[Sequence[Panel]], path: Path, *, colors: int) -> None:
    """Set rows of panels under one another, and write a PNG of ``colors`` colours."""
    heights = [len(row[0].picture) + LABEL for row in rows]
    width = max(sum(panel.picture.shape[1] + GAP for panel in row) for row in rows) + GAP
    page = PillowImage.new("RGB", (width, sum(heights) + GAP), PAPER)
    draw = ImageDraw.Draw(page)
    for i, row in enumerate(rows):
        left, top = GAP, sum(heights[:i])
        for panel in row:
            draw.text((left, top + LABEL / 2), panel.label, fill=INK, font=_font(), anchor="lm")
            page.paste(PillowImage.fromarray(panel.picture), (left, top + LABEL))
            left += panel.picture.shape[1] + GAP
    none = PillowImage.Dither.NONE
    palette = page.quantize(colors, PillowImage.Quantize.MEDIANCUT, kmeans=colors, dither=none)
    with atomic_file(path) as partial:
        palette.save(partial, format="PNG", optimize=True)


def _font() -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size=15)


if __name__ == "__main__":
    main()
