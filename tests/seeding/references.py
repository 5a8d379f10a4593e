"""Coverage, cover and thinning as literal loops, and made views to test them with."""

from __future__ import annotations

import math

import numpy as np

from splatseed.camera import Camera
from splatseed.photos.view import View
from splatseed.photos.viewpoint import look_at

SURFACE, MIN_NEARER, CHECKED_VIEWS = 0.1, 5, 12


def make_view(rng, width=40, height=32, focal=30.0, eye=None, target=(0.0, 0.0, 0.0), name="view"):
    """A view of random pixels, by default from a random place 2 to 6 away."""
    eye = rng.normal(size=3) if eye is None else np.asarray(eye, float)
    eye = eye / np.linalg.norm(eye) * rng.uniform(2, 6)
    K = np.array([[focal, 0, width / 2], [0, focal * 1.1, height / 2], [0, 0, 1.0]])
    pixels = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    pose = look_at(eye, np.asarray(target, float), np.array([0.1, 0.2, 1.0]))
    return View(name, pixels, Camera(K, width, height, pose))


def matrix_of(view, cell):
    rows, cols = math.ceil(view.height / cell), math.ceil(view.width / cell)
    scale = np.diag([cols / view.width, rows / view.height, 1.0])
    return scale @ view.K @ view.cam_from_world[:3], rows, cols


def project(point, m):
    """Column, row, depth; None behind the camera."""
    x, y, z = map(float, point)
    column, row, depth = (r[0] * x + r[1] * y + r[2] * z + r[3] for r in m.tolist())
    return (column * (1 / depth), row * (1 / depth), depth) if depth > 0 else None


def cell_depths(view, xyz, cell):
    m, rows, cols = matrix_of(view, cell)
    found = {}
    for point in xyz:
        at = project(point, m)
        if at and 0 <= at[0] < cols and 0 <= at[1] < rows:
            found.setdefault((int(at[1]), int(at[0])), []).append(np.float32(at[2]))
    quartiles = {key: sorted(values)[len(values) // 4] for key, values in found.items()}
    depths = np.full((rows, cols), np.inf, np.float32)
    for (i, j), depth in quartiles.items():
        around = [quartiles.get((i + a, j + b), np.inf) for a in (-1, 0, 1) for b in (-1, 0, 1)]
        if sum(other < depth * np.float32(1 - SURFACE) for other in around) < MIN_NEARER:
            depths[i, j] = depth
    return depths


def sector(dy, dx):
    """Which eighth of the circle, counted from the direction of x towards that of y."""
    return int(math.degrees(math.atan2(dy, dx)) % 360 // 45)


def lift(view, cell, i, j, depth):
    m, _, _ = matrix_of(view, cell)
    back = np.linalg.inv(np.vstack([m, [0, 0, 0, 1]]))
    return (back @ [(j + 0.5) * depth, (i + 0.5) * depth, depth, 1])[:3]


def contradictions(point, others):
    """How many of (matrix, depths of cells) see through a point."""
    count = 0
    for m, seen in others:
        at = project(point, m)
        if at and 0 <= at[0] < seen.shape[1] and 0 <= at[1] < seen.shape[0]:
            there = float(seen[int(at[1]), int(at[0])])
            count += there < math.inf and at[2] < there * (1 - SURFACE)
    return count


def guess(view, cell, depths, i, j, others):
    """Depth of an empty cell and the distance to the nearest covered one."""
    covered = [(a - i, b - j) for a, b in np.argwhere(np.isfinite(depths))]
    reach = min(max(abs(dy), abs(dx)) for dy, dx in covered)
    near = sorted(
        (dy**2 + dx**2, max(abs(dy), abs(dx)), dy, dx)
        for dy, dx in covered
        if max(abs(dy), abs(dx)) <= 2 * reach + 1
    )
    sectors = {}
    for square, _, dy, dx in near:
        sectors.setdefault(sector(dy, dx), (depths[i + dy, j + dx], square))
    votes = sorted(
        (z, 1 / ((1 + contradictions(lift(view, cell, i, j, float(z)), others)) * square))
        for z, square in sectors.values()
    )
    half = below = 0.0
    for _, weight in votes:
        half += 0.5 * weight
    for z, weight in votes:
        below += weight
        if below >= half:
            return z, math.sqrt(near[0][0])
    raise AssertionError


def cover(views, xyz, cell, rng):
    """Positions and colours of the seeds, and their views."""
    cloud, seeds, coarse = list(xyz), [], max(cell, 8)
    seen = [(matrix_of(view, coarse)[0], cell_depths(view, xyz, coarse)) for view in views]
    for v in rng.permutation(len(views)):
        others = rng.choice(len(views) - 1, min(CHECKED_VIEWS, len(views) - 1), replace=False)
        others = [seen[o + (o >= v)] for o in others]
        view, depths = views[v], cell_depths(views[v], cloud, cell)
        rows, cols = depths.shape
        for i, j in np.argwhere(np.isinf(depths)):
            depth, reach = guess(view, cell, depths, i, j, others)
            box = view.photograph[
                i * view.height // rows : (i + 1) * view.height // rows,
                j * view.width // cols : (j + 1) * view.width // cols,
            ]
            point = np.float32(lift(view, cell, i, j, float(depth)))
            cloud.append(point)
            seeds.append((point, box.reshape(-1, 3).mean(axis=0), v, max(0.1, 0.3 / reach)))
    return seeds


def closest_places(point, views):
    """View, column, row and slice of depth in the views that see a point most closely."""
    seen = []
    for v, view in enumerate(views):
        at = project(point, matrix_of(view, 1)[0])
        if at and 0 <= at[0] < view.width and 0 <= at[1] < view.height:
            focal = math.sqrt(view.K[0, 0] * view.K[1, 1])
            seen.append((-(focal / at[2]), v, at[0], at[1], math.log(at[2]) * focal / 4))
    return [(v, *map(np.float32, place)) for _, v, *place in sorted(seen)[:4]]


def keep(xyz, views, order, spacing):
    """Indices of the points that are needed at a spacing."""
    marked, kept = set(), []
    for i in order:
        cells = [
            (v, *(math.floor(x / spacing) for x in place))
            for v, *place in closest_places(xyz[i], views)
        ]
        if cells and cells[0] not in marked:
            kept.append(i)
            marked.update(cells)
    return kept
