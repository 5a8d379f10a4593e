"""What ``splatseed sfm`` does about points and inputs that COLMAP does not mind."""

from __future__ import annotations

import pytest

from splatseed.errors import SceneNotFoundError
from splatseed.sfm import reconstruct
from splatseed.sfm.export import drop_repeats

pycolmap = pytest.importorskip("pycolmap")


def test_of_points_at_one_place_the_longest_track_stays(room_path):
    model = pycolmap.Reconstruction(room_path / "sparse" / "0")
    by_length = sorted(model.point3D_ids(), key=lambda each: model.point3D(each).track.length())
    short, long = by_length[0], by_length[-1]
    model.point3D(short).xyz = model.point3D(long).xyz
    count = model.num_points3D()
    drop_repeats(model)
    assert model.num_points3D() == count - 1
    assert not model.exists_point3D(short)
    assert model.exists_point3D(long)
    seen = {p.point3D_id for image in model.images.values() for p in image.points2D}
    assert short not in seen


def test_what_is_neither_photographs_nor_a_video_is_told_of_both(tmp_path):
    with pytest.raises(
        SceneNotFoundError, match=r"or a video at .*nope\.mp4; found nothing.*\.mov"
    ):
        reconstruct(tmp_path / "nope.mp4", tmp_path / "out")
