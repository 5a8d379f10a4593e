"""Made captures of single surfaces, a few small views each, and what is true of their maps.

Notation: V views on an arc, W x H pixels; the surfaces stand about the world's origin, the cameras
``FAR`` before it on -z. Promise: photographs are ray cast, so that depth and normals at any place
of any view are exact.
"""

from __future__ import annotations

import numpy as np
from PIL import Image as PillowImage

from splatseed.camera import Camera, Intrinsics, quat_from_rotation
from splatseed.photos.viewpoint import look_at
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource
from splatseed.synthetic.room import Room, pixel_rays, render_view
from splatseed.synthetic.surfaces import Rectangle, Sphere, Union
from splatseed.synthetic.texture import Mottled, Plain

WIDTH, HEIGHT, FOCAL = 96, 80, 100.0
FAR = 3.0
ANGLES = (0.0, -7.0, 7.0, -14.0, 14.0)
"""Degrees of the cameras on their arc."""
DOWN = np.array([0.0, -1.0, 0.0])

STONE = Mottled(((0.1,) * 3, (0.9,) * 3), (7.0, 7.0, 7.0), octaves=3, contrast=3.0)
GREY = Plain((0.5, 0.5, 0.5))


def arc(angles=ANGLES, size=(WIDTH, HEIGHT), focal=FOCAL):
    """Cameras that look at the origin from so many degrees to the side."""
    K = np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])
    turns = np.radians(angles)
    eyes = [FAR * np.array([np.sin(turn), 0.1 * np.sin(3 * turn), -np.cos(turn)]) for turn in turns]
    return [Camera(K, *size, look_at(eye, np.zeros(3), DOWN)) for eye in eyes]


def tilted_plane(degrees=30.0):
    """A plane through the origin, turned about the vertical."""
    along = np.array([np.cos(np.radians(degrees)), 0.0, np.sin(np.radians(degrees))])
    return Union((Rectangle(-4 * along - 4 * DOWN, 8 * along, 8 * DOWN),))


def ball_before_wall():
    """A sphere at the origin, a wall a little behind it."""
    wall = Rectangle(np.array([-4.0, 4.0, 0.8]), np.array([8.0, 0, 0]), np.array([0, -8.0, 0]))
    return Union((Sphere(np.zeros(3), 0.7), wall))


def photograph(folder, surfaces, cameras, *, texture=STONE, num_points=100):
    """A scene of the surfaces in front of the cameras, its photographs in a folder."""
    room = Room(("made",) * len(surfaces.parts), surfaces, (texture,) * len(surfaces.parts))
    folder.mkdir(parents=True, exist_ok=True)
    images = []
    for i, camera in enumerate(cameras):
        name, pose = f"{i:02d}.png", camera.cam_from_world
        PillowImage.fromarray(render_view(room, camera)[0]).save(folder / name)
        params = (camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2])
        lens = Intrinsics(i + 1, "PINHOLE", camera.width, camera.height, params)
        images.append(Image(name, i + 1, lens, quat_from_rotation(pose[:3, :3]), pose[:3, 3]))
    # Points where random rays of the first camera meet the surfaces.
    rays = pixel_rays(cameras[0])
    rays = rays[np.random.default_rng(0).choice(len(rays), num_points, replace=False)]
    xyz = _meet(surfaces, cameras[0], rays).astype(np.float32)
    points = PointCloud(xyz, np.zeros((num_points, 3), np.uint8))
    source = SceneSource("colmap", folder, folder, image_dir=folder)
    return Scene(points, tuple(images), tuple(i.intrinsics for i in images), source=source)


def _meet(surfaces, camera, rays):
    """Where a camera's rays meet the surfaces."""
    return camera.center + surfaces.intersect(camera.center, rays)[:, None] * rays


def true_depth(surfaces, camera):
    """Planar depth at the centres of a camera's pixels, [H, W]."""
    depth = surfaces.intersect(camera.center, pixel_rays(camera))
    return depth.reshape(camera.height, camera.width)


def true_normals(surfaces, camera):
    """Unit normals there in the camera's axes, towards it, [H, W, 3]."""
    rays = pixel_rays(camera)
    normals = surfaces.normals(_meet(surfaces, camera, rays))
    normals = normals * -np.sign(np.einsum("ij,ij->i", normals, rays))[:, None]
    return (normals @ camera.cam_from_world[:3, :3].T).reshape(camera.height, camera.width, 3)


def relative_error(surfaces, stereo_map):
    """Of the depths that a map has, against the truth, [M]."""
    known = np.isfinite(stereo_map.depth)
    return np.abs(stereo_map.depth[known] / true_depth(surfaces, stereo_map.camera)[known] - 1.0)


def degrees_off(surfaces, stereo_map):
    """Angles between the normals of a map and the true ones, [M]."""
    known = np.isfinite(stereo_map.depth)
    cosine = (stereo_map.normal * true_normals(surfaces, stereo_map.camera)).sum(axis=-1)[known]
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
