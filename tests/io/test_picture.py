"""Pictures have the size and pixels that are stored, whatever their orientation says."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.io.depth_files import read_stored
from splatseed.io.photograph import check_photograph, read_photograph
from splatseed.io.photograph_checks import photograph_size


@pytest.mark.parametrize("compression", [None, "tiff_lzw"])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_tiff_is_read_as_stored(tmp_path, orientation, compression):
    pixels = np.random.default_rng(0).integers(0, 256, (30, 40, 3), np.uint8)
    exif = PilImage.Exif()
    exif[0x0112] = orientation
    how = {"exif": exif, "compression": compression}
    path = tmp_path / "a.tif"
    PilImage.fromarray(pixels).save(path, **how)
    with PilImage.open(BytesIO(path.read_bytes())) as turned:  # by Pillow
        assert np.array_equal(np.asarray(turned), pixels) == (orientation == 1)
    assert photograph_size(path) == check_photograph(path) == (40, 30)
    assert np.array_equal(read_photograph(path), pixels)
    depth = (pixels[..., 0].astype(np.uint16) + 1) * 100
    for values in (depth, depth.astype(np.float32)):
        PilImage.fromarray(values).save(path, **how)
        assert np.array_equal(read_stored(path), values)
    PilImage.fromarray(depth).save(path, **how)
    assert np.abs(read_photograph(path, 25600)[..., 0] - depth * (255 / 25600)).max() < 0.51
