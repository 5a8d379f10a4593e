"""Names that a model spells otherwise than the file system: found, or the cause is named."""

from __future__ import annotations

import os
import shutil
import unicodedata

import pytest

from splatseed.cli import main
from splatseed.errors import SceneFormatError
from splatseed.io import load_scene, write_scene

NFC, NFD = (unicodedata.normalize(form, "küche/süß {}.png") for form in ("NFC", "NFD"))


@pytest.fixture
def spelled(scene_dir, model):
    """Renames the photographs, and writes text or binary models; names are bytes."""

    def write(on_disk, in_model, binary):
        names = [image.name for image in model.images]
        images = os.fsencode(scene_dir / "images")
        for i, name in enumerate(names):
            target = os.path.join(images, on_disk(i))  # noqa: PTH118  (bytes)
            os.makedirs(os.path.dirname(target), exist_ok=True)  # noqa: PTH103, PTH120
            os.rename(os.path.join(images, name.encode()), target)  # noqa: PTH104, PTH118
        file = scene_dir / "sparse/0" / f"images.{'bin' if binary else 'txt'}"
        if binary:
            data = file.read_bytes()
            for i, name in enumerate(names):
                data = data.replace(name.encode() + b"\0", in_model(i) + b"\0")
            file.write_bytes(data)
        else:
            (scene_dir / "sparse/0/images.bin").unlink()
            rows = [b"%d 1 0 0 0 0 0 %d 7 %s\n\n" % (i, i, in_model(i)) for i in range(len(names))]
            file.write_bytes(b"".join(rows))
        return scene_dir

    return write


@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize(
    ("disk", "listed", "encoding"),
    [(NFC, NFD, "utf-8"), (NFD, NFC, "utf-8"), (NFC, NFC, "cp1252"), (NFD, NFC, "cp1252"),
     ("照片{}.png", "照片{}.png", "gbk"), ("写真{}.png", "写真{}.png", "shift_jis")],
)  # fmt: skip
def test_files_are_found_and_name_the_images(spelled, tmp_path, disk, listed, encoding, binary):
    scene_dir = spelled(
        lambda i: disk.format(i).encode(), lambda i: listed.format(i).encode(encoding), binary
    )
    scene = load_scene(scene_dir)
    assert [image.name for image in scene.images] == [disk.format(i) for i in range(4)]
    assert all(image.has_photograph for image in scene.images)
    assert [each.kind for each in scene.findings if "name" in each.kind] == ["renamed-images"]
    write_scene(scene, tmp_path / "out")
    again = load_scene(tmp_path / "out")
    assert not [each for each in again.findings if each.kind == "renamed-images"]
    assert all(image.has_photograph for image in again.images)


def test_names_that_match_are_left(spelled):
    scene = load_scene(
        spelled(lambda i: NFD.format(i).encode(), lambda i: NFD.format(i).encode(), 1)
    )
    assert [image.name for image in scene.images] == [NFD.format(i) for i in range(4)]
    assert not any(each.kind == "renamed-images" for each in scene.findings)


def test_files_in_another_encoding_are_named_as_the_cause(spelled, capsys):
    scene_dir = spelled(
        lambda i: f"照片{i}.png".encode("gbk"), lambda i: f"照片{i}.png".encode("gbk"), 1
    )
    with pytest.raises(SceneFormatError, match=r"照片0\.png in gbk") as error:
        load_scene(scene_dir)
    assert "convmv" in error.value.fix
    with pytest.raises(SystemExit):
        main(["info", str(scene_dir)])
    assert "照片0.png in gbk" in capsys.readouterr().err


def test_names_without_files_are_named_as_the_cause(spelled):
    scene_dir = spelled(lambda i: b"%d.png" % i, lambda i: NFC.format(i).encode("cp1252"), 1)
    with pytest.raises(SceneFormatError, match=r"süß 0\.png in cp1252"):
        load_scene(scene_dir)
    shutil.rmtree(scene_dir / "images")
    with pytest.raises(SceneFormatError, match=r"images\.bin"):
        load_scene(scene_dir)


def test_an_undecodable_number_is_an_error(spelled):
    scene_dir = spelled(lambda i: b"%d.png" % i, lambda i: b"%d.png" % i, 0)
    path = scene_dir / "sparse/0/images.txt"
    path.write_bytes(path.read_bytes().replace(b"1 0 0", b"1 \xff 0"))
    with pytest.raises(SceneFormatError, match="line 1"):
        load_scene(scene_dir)
