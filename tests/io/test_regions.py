"""Regions as users write them."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io.regions import parse_region


def test_a_sphere_and_a_turned_box_hold_what_they_should(rng, tmp_path):
    xyz = rng.uniform(-2, 2, (2000, 3))
    apart = np.linalg.norm(xyz - [0.5, 0, -0.2], axis=1)
    np.testing.assert_array_equal(parse_region("0.5,0,-0.2,1.2")(xyz), apart <= 1.2)
    # A box of 2 x 1 x 3, turned by 30 degrees about z, at (0.3, 0.2, 0.1).
    turn = Rotation.from_euler("z", 30, degrees=True).as_matrix()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn * [2, 1, 3], [0.3, 0.2, 0.1]
    inside = (np.abs((xyz - [0.3, 0.2, 0.1]) @ turn) <= [1, 0.5, 1.5]).all(axis=1)
    assert 100 < inside.sum() < 500
    (tmp_path / "box.json").write_text(json.dumps({"matrix": matrix.tolist()}))
    np.savetxt(tmp_path / "box.txt", matrix)
    rows = ",".join(map(str, matrix[:3].ravel()))
    for text in (rows, str(tmp_path / "box.json"), str(tmp_path / "box.txt")):
        np.testing.assert_array_equal(parse_region(text)(xyz), inside)


@pytest.mark.parametrize(
    "text", ["0,0,0,1,1,0", "a,b,c,d,e,f", "0,0,0,1,1,nan", "0,0,0,-1", "0,0,nan,1", "1,2", ""]
)
def test_no_region(text):
    with pytest.raises((ParameterError, SceneNotFoundError), match=r"region|a file at"):
        parse_region(text)
