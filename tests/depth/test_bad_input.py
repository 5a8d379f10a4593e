"""What cannot be lifted, and what is said of it."""

from __future__ import annotations

import dataclasses
import shutil

import numpy as np
import pytest

import splatseed as ss
from splatseed.camera import Intrinsics
from splatseed.errors import (
    SceneFormatError,
    SceneNotFoundError,
)


def upsample(scene, **options):
    return ss.upsample(scene, "depth", ratio=2, **options)


def test_maps_must_be_named(exact):
    for scene in (
        exact.points,
        exact.replace(depths=None),
        exact.replace(depths={}),
        exact.replace(images=()),
    ):
        with pytest.raises(SceneNotFoundError, match=r"maps of none of them.*--depth DIR"):
            upsample(scene)


def test_photographs_must_be_there(exact, tmp_path):
    with pytest.raises(SceneNotFoundError, match="photographs, from which points take"):
        upsample(exact.replace(source=None))
    folder = tmp_path / "images"
    shutil.copytree(exact.source.image_dir, folder)
    (folder / "view_004.png").unlink()
    moved = exact.replace(source=dataclasses.replace(exact.source, image_dir=folder))
    with pytest.raises(SceneNotFoundError, match=r"view_004\.png; found no such file"):
        upsample(moved)
    (folder / "view_004.png").write_bytes(b"no image")
    with pytest.raises(SceneFormatError, match=r"view_004\.png to be an image"):
        upsample(moved)


def test_a_photograph_of_another_shape_is_refused(exact, tmp_path):
    from PIL import Image as PilImage

    folder = tmp_path / "images"
    shutil.copytree(exact.source.image_dir, folder)
    with PilImage.open(folder / "view_002.png") as picture:
        picture.load()
    picture.resize((120, 160)).save(folder / "view_002.png")
    moved = exact.replace(source=dataclasses.replace(exact.source, image_dir=folder))
    with pytest.raises(SceneFormatError, match=r"view_002\.png.*160 x 120; found 120 x 160"):
        upsample(moved)
    picture.resize((320, 240)).save(folder / "view_002.png")  # another size is no harm
    assert upsample(moved).finite.all()


def test_a_lens_with_distortion_is_refused(exact):
    lens = exact.images[0].intrinsics
    f, cx, cy = lens.params[0], *lens.params[2:]
    for k, refused in ((0.1, True), (0.0, False)):
        bent = Intrinsics(1, "SIMPLE_RADIAL", 160, 120, (f, cx, cy, k))
        images = tuple(dataclasses.replace(image, intrinsics=bent) for image in exact.images)
        if refused:
            with pytest.raises(SceneFormatError, match="SIMPLE_RADIAL for view_000"):
                upsample(exact.replace(images=images))
        else:
            assert upsample(exact.replace(images=images)).finite.all()


def test_units_a_thousand_times_too_large_are_aligned_or_refused(exact, make_maps):
    scene = exact.replace(depths=make_maps("z", lambda z, _: 1000 * z))
    aligned = upsample(scene)
    plain = upsample(exact)
    assert np.median(np.linalg.norm(aligned.xyz - plain.xyz, axis=1)) < 0.01
    with pytest.raises(SceneFormatError, match=r"1e\+03 times.*--depth-scale"):
        upsample(scene, align=False)


def test_infinities_zeros_and_negatives_are_never_lifted(exact, make_maps):
    def change(z, i):
        z = z.copy()
        z[::3] = (np.inf, 0.0, -1.0)[i % 3]
        return z

    for profile in ("default", "paper"):
        seeds = upsample(exact.replace(depths=make_maps("z", change)), profile=profile)
        assert seeds.finite.all()
        assert np.abs(seeds.xyz).max() < 10
