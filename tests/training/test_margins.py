"""Margins: what lies past the frames has the depth and colour of what is beside it."""

from __future__ import annotations

import dataclasses

import numpy as np

from splatseed.photos.loading import load_views
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import training_frame
from splatseed.training.margins import NEAR, SHARE, continued, has_margins, with_margins
from splatseed.training.settings import TrainSettings


def test_values_continue_smoothly_and_known_ones_stay():
    row, column = np.mgrid[:40, :51]
    values = np.stack([np.full((40, 51), 0.3), 0.5 + 0.01 * column], axis=2)
    known = (np.abs(row - 20) < 12) & (np.abs(column - 25) < 14)
    filled = continued(np.where(known[..., None], values, 0), known)
    assert (filled[known] == values[known]).all()
    np.testing.assert_allclose(filled[..., 0], 0.3)
    edge = [values[20, k, 1] for k in (12, 38)]
    assert abs(filled[20, 9, 1] - edge[0]) < 0.06
    assert abs(filled[20, 41, 1] - edge[1]) < 0.06
    assert filled[..., 1].min() > 0.6
    assert filled[..., 1].max() < 0.9


def test_a_view_beyond_the_frames_is_no_longer_black(room):
    views = load_views(room, room.images)[:3]
    model = initial_gaussians(room.points, opacity=0.9)
    frame = training_frame(views, room.points.xyz)
    grown = with_margins(model, frame, views, 100 * len(model))
    added = len(grown) - len(model)
    assert added > 100
    assert (grown.means[: len(model)] == model.means).all()
    # None lies within a frame.
    for view in views:
        uv, z = view.camera.project(grown.means[len(model) :].astype(np.float64))
        inside = (z > 0) & ((uv > 0) & (uv < [view.width, view.height])).all(axis=1)
        assert not inside.any()
    cap = len(model) + added // 2
    capped = with_margins(model, frame, views, cap)
    assert len(capped) <= cap
    assert (
        len(capped) - len(np.intersect1d(capped.means[:, 0], model.means[:, 0])) <= SHARE * cap + 1
    )

    def black(gaussians, view):
        return (ModelRenderer(gaussians, frame).color(view).sum(axis=2) < 0.02).mean()

    wide = [_wider(view) for view in views]
    before, after = (np.mean([black(each, view) for view in wide]) for each in (model, grown))
    assert after < 0.5 * before


def test_no_margin_hides_what_another_camera_shows(room):
    views = load_views(room, room.images)
    model = initial_gaussians(room.points, opacity=0.9)
    frame = training_frame(views, room.points.xyz)
    added = with_margins(model, frame, views, 100 * len(model)).means[len(model) :]
    assert len(added) > 50
    for view in views:
        depth = ModelRenderer(model, frame).depth(view)
        distance = np.linalg.norm(added - view.camera.center, axis=1)
        # The depths are those of a smaller frame: one in a hundred is leeway.
        assert distance.min() > 0.99 * np.quantile(depth[depth > 0], NEAR)


def test_a_small_cap_leaves_room_for_none(room):
    views, stages = load_views(room, room.images)[:3], []
    model = initial_gaussians(room.points, opacity=0.9)
    frame = training_frame(views, room.points.xyz)
    within = with_margins(
        model, frame, views, len(model), progress=lambda *stage: stages.append(stage)
    )
    assert len(within) <= len(model)
    assert {name for name, _ in stages} == {"margins"}
    shares = [share for _, share in stages]
    assert shares == sorted(shares)
    assert shares.index(0.5) == 2  # of three views, before the first pass
    assert shares[-2] < shares[-1] == 1
    ends = shares[5::3]  # of passes, of which there are many
    assert len(ends) > 4
    assert np.diff(ends).min() > 0.2 * np.diff(ends[1:]).max()  # all about as long
    few = model.select(np.arange(20))
    assert len(with_margins(few, frame, views, 20)) <= 20


def _wider(view):
    """The view with a frame that is wider by a fifth on each side."""
    K = view.K.copy()
    right, down = view.width // 5, view.height // 5
    K[:2, 2] += [right, down]
    camera = dataclasses.replace(
        view.camera, K=K, width=view.width + 2 * right, height=view.height + 2 * down
    )
    return dataclasses.replace(view, camera=camera, photograph=np.empty((0, 0, 3), np.uint8))


def test_models_that_grow_on_whole_photographs_have_margins(room):
    views = load_views(room, room.images)
    settings = TrainSettings()
    assert has_margins(settings, views)
    assert not has_margins(dataclasses.replace(settings, start="model.ply"), views)
    assert not has_margins(dataclasses.replace(settings, strategy="default-3dgs"), views)
    assert not has_margins(dataclasses.replace(settings, strategy="none"), views)
    cut_out = dataclasses.replace(views[0], opacity=views[0].photograph[..., 0])
    assert not has_margins(settings, [cut_out, *views])
