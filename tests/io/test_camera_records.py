"""Poses that are not rigid: each kind has its message."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import SceneFormatError
from splatseed.io.camera_records import rigid_pose

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.mark.parametrize(
    ("factors", "last", "found"),
    [
        ([1.3, 1.3, 1.3], [0, 0, 0, 1], "one scaled by 1.3"),
        ([1, 1.2, 1], [0, 0, 0, 1], "a sheared one"),
        ([-1, 1, 1], [0, 0, 0, 1], "a mirrored one"),
        ([1, 1, 1], [0, 0, 0, 2], "0, 0, 0, 2 as its last row"),
        ([1e300, 1e300, 1e300], [0, 0, 0, 1], "a sheared one"),  # overflows
    ],
)
def test_what_is_wrong_with_a_pose_is_named(factors, last, found):
    pose = np.vstack([np.column_stack([TURN * factors, [1.0, 2, 3]]), last])
    with pytest.raises(SceneFormatError, match=f"a rotation and a translation.*found {found}"):
        rigid_pose("a file", pose)
