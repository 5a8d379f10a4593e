"""Files of trained Gaussians that are named as a scene are known for what they are."""

from __future__ import annotations

import pytest

from splatseed.errors import SceneFormatError
from splatseed.io import load_scene
from splatseed.io.ply.points import read_ply

PACKED = """ply
format binary_little_endian 1.0
element chunk 1
property float min_x
element vertex 256
property uint packed_position
property uint packed_rotation
end_header
"""


@pytest.mark.parametrize("suffix", [".spz", ".splat", ".ksplat", ".sog", ".SPZ"])
def test_a_model_that_is_no_scene_is_named(suffix, tmp_path):
    path = tmp_path / f"model{suffix}"
    path.write_bytes(b"\x1f\x8b")
    with pytest.raises(SceneFormatError, match=r"found Gaussians .*a trained model. Score it"):
        load_scene(path)


def test_a_compressed_ply_is_named(tmp_path):
    path = tmp_path / "model.compressed.ply"
    path.write_bytes(PACKED.encode() + bytes(4 + 256 * 8))
    with pytest.raises(SceneFormatError, match=r"PlayCanvas's .compressed.ply"):
        read_ply(path)
