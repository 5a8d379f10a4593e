"""``--overwrite`` spares what is the user's, and removes all that is ours, read-only or not."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from splatseed.errors import OutputError
from splatseed.io import load_scene, write_scene
from splatseed.io.output.staging import MANIFEST, add_files, output_folder
from splatseed.synthetic import make_capture, write_capture


@pytest.fixture
def output(scene_dir, tmp_path):
    return write_scene(load_scene(scene_dir), tmp_path / "out").path


def overwrite(path, **options):
    return write_scene(load_scene(path.with_name("scene")), path, overwrite=True, **options)


def hidden(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def test_the_users_files_are_spared_and_three_are_named(output):
    (output / "results").mkdir()
    for name in ("a.pt", "b.pt", "c.pt", "d.pt"):
        (output / "results" / name).touch()
    with pytest.raises(OutputError, match=r"results/a\.pt, .*results/c\.pt and 1 more"):
        overwrite(output)
    assert (output / "results/d.pt").is_file()
    shutil.rmtree(output / "results")
    overwrite(output)


@pytest.mark.parametrize("name", ["sparse/0/project.ini", "notes.txt", "images_8", "sparse/1"])
def test_a_file_or_link_of_the_users_counts_wherever_it_lies(output, name):
    (output / name).symlink_to(output / MANIFEST)
    with pytest.raises(OutputError, match=name):
        overwrite(output)


@pytest.mark.parametrize("copy", [False, True])
def test_pictures_and_image_folders_are_ours(output, copy):
    overwrite(output, copy_images=copy)
    for name in ("preview.png", "preview_methods.png"):
        (output / name).touch()
    overwrite(output)
    assert not (output / "preview.png").exists()
    assert hidden(output.parent) == []


@pytest.mark.parametrize("text", ["{}", '{"command": "write_scene"}', "not JSON", "[]"])
def test_a_manifest_without_a_list_allows_nothing(output, text):
    (output / MANIFEST).write_text(text)
    before = sorted(output.rglob("*"))
    with pytest.raises(OutputError, match="does not say what splatseed wrote"):
        overwrite(output)
    assert sorted(output.rglob("*")) == before


def test_only_the_kind_that_wrote_a_folder_may_replace_it(output):
    with pytest.raises(OutputError, match="found what splatseed write_scene wrote, not upsample"):
        overwrite(output, provenance={"command": "upsample"})
    with output_folder(output.with_name("run"), kind="train") as folder:
        (folder / "point_cloud.ply").touch()
    with pytest.raises(OutputError, match="found what splatseed train wrote"):
        overwrite(output.with_name("run"))
    assert (output.with_name("run") / "point_cloud.ply").exists()


def test_a_note_in_a_folder_of_copies_is_spared(output):
    overwrite(output, copy_images=True)
    (output / "images/notes.txt").write_text("the third one is best")
    with pytest.raises(OutputError, match=r"images/notes\.txt"):
        overwrite(output)


def test_what_is_put_there_while_we_work_is_spared(output):
    with (
        pytest.raises(OutputError, match=r"new output is complete there; .* kept as .*\.out\.old-"),
        output_folder(output, kind="write_scene", overwrite=True),
    ):
        (output / "notes.txt").touch()
    (kept,) = hidden(output.parent)
    assert (output.with_name(kept) / "notes.txt").exists()


def test_an_output_in_an_output_has_its_own_list(output):
    (output / "run").mkdir()
    (output / "run" / MANIFEST).write_text('{"command": "train", "files": ["metrics.json"]}')
    (output / "run/metrics.json").touch()
    with pytest.raises(OutputError, match=r"run/metrics\.json"):
        overwrite(output)
    add_files(output, ["run"])
    (output / "run/notes.txt").touch()
    with pytest.raises(OutputError, match=r"did not write: run/notes\.txt"):
        overwrite(output)
    (output / "run/notes.txt").unlink()
    overwrite(output)


@pytest.mark.parametrize(
    "name",
    [
        "images_2_png/left/a.png",
        ".points.partial-0123abcd",
        ".a.partial-0123abcd.pt",
        ".results.partial-0123abcd/renders/a.png",
    ],
)
def test_what_can_be_made_again_is_in_nobodys_way(output, name):
    (output / name).parent.mkdir(parents=True, exist_ok=True)
    (output / name).touch()
    overwrite(output)
    assert not (output / name).exists()


@pytest.mark.parametrize("copy", [False, True])
def test_smaller_copies_that_nerfstudio_makes_are_in_nobodys_way(scene_dir, tmp_path, copy):
    (scene_dir / "images").mkdir(exist_ok=True)
    scene = load_scene(scene_dir)
    for image in scene.images:
        (scene_dir / "images" / image.name).parent.mkdir(parents=True, exist_ok=True)
        (scene_dir / "images" / image.name).touch()
    output = write_scene(load_scene(scene_dir), tmp_path / "out", copy_images=copy).path
    for factor in (2, 4, 8):
        small = output / f"images_{factor}" / scene.images[0].name
        small.parent.mkdir(parents=True)
        small.touch()
    overwrite(output)
    assert not (output / "images_2").exists()
    (output / "images_2").mkdir()
    (output / "images_2/mine.png").touch()
    with pytest.raises(OutputError, match=r"images_2/mine\.png"):
        overwrite(output)


def test_files_may_be_listed_later(output):
    (output / "extra").mkdir()
    (output / "extra/file").touch()
    add_files(output, ["extra"])
    overwrite(output)
    assert not (output / "extra").exists()


def test_a_made_up_capture_may_be_replaced(tmp_path):
    capture = make_capture(seed=0, num_views=4)
    write_capture(capture, tmp_path / "room")
    write_capture(capture, tmp_path / "room", overwrite=True)
    listed = json.loads((tmp_path / "room" / MANIFEST).read_text())["files"]
    assert {"images/view_000.png", "depths/depths.json"} <= set(listed)


def test_copies_of_read_only_images_are_writable(scene_dir, tmp_path):
    folders = [scene_dir / "images", scene_dir / "images/left"]
    for folder in folders:
        folder.chmod(0o555)
    try:
        write_scene(load_scene(scene_dir), tmp_path / "out", copy_images=True)
    finally:
        for folder in folders:
            folder.chmod(0o755)
    copies = tmp_path / "out/images"
    assert all(path.stat().st_mode & 0o200 for path in [copies, *copies.rglob("*")])
    pictures = [path for path in (scene_dir / "images").rglob("*") if path.is_file()]
    for path in pictures:
        copy = copies / path.relative_to(scene_dir / "images")
        assert copy.read_bytes() == path.read_bytes()


READ_ONLY = """
import sys
from pathlib import Path
from splatseed.io.output.staging import output_folder

out, pictures = Path(sys.argv[1]) / "out", Path(sys.argv[1]) / "pictures"
def write():
    with output_folder(out, kind="test", overwrite=True) as partial:
        (partial / "deep/er").mkdir(parents=True)
        (partial / "deep/er/file").touch()
        (partial / "link").symlink_to(pictures, target_is_directory=True)
        (partial / "deep/er").chmod(0o555)
        (partial / "deep").chmod(0o555)
        if len(sys.argv) > 2:
            raise KeyboardInterrupt
try:
    write()
    write()
except KeyboardInterrupt:
    pass
"""


def bound_by_permissions(*words):
    """Run Python as a user whom permissions bind, also where the tests run as root."""
    if sys.platform == "win32":
        pytest.skip("needs POSIX permissions")
    run = [sys.executable, "-c", *map(str, words)]
    if os.geteuid() == 0:
        setpriv = shutil.which("setpriv")
        if setpriv is None:
            pytest.skip("the tests run as root, and setpriv is not there")
        run = [setpriv, "--bounding-set=-dac_override,-dac_read_search,-fowner", *run]
    return subprocess.run(run, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("how", [(), ("interrupted",)])
def test_read_only_folders_of_ours_are_removed_and_links_are_not_followed(tmp_path, how):
    (tmp_path / "pictures").mkdir(mode=0o555)
    (tmp_path / "pictures").chmod(0o555)
    run = bound_by_permissions(READ_ONLY, tmp_path, *how)
    assert (run.returncode, run.stderr) == (0, "")
    assert hidden(tmp_path) == []
    assert (tmp_path / "out").exists() == (not how)
    assert (tmp_path / "pictures").stat().st_mode & 0o777 == 0o555


def refuse(*_args, **_options):
    raise OSError(errno.EBUSY, "Device or resource busy")


def test_what_cannot_be_removed_is_told(output, monkeypatch):
    monkeypatch.setattr(shutil, "rmtree", refuse)
    with pytest.raises(OutputError, match=r"\.out\.old-.*busy.*new output is complete"):
        overwrite(output)
    assert [name[:9] for name in hidden(output.parent)] == [".out.old-"]

    def fail():
        with output_folder(output.with_name("new"), kind="test"):
            raise OSError(errno.ENOSPC, "No space left on device")

    with pytest.raises(OutputError, match=r"\.new\.partial-.*No space left.*busy") as caught:
        fail()
    assert "was left behind" not in str(caught.value)


@pytest.mark.parametrize("renames", [1, 2])
def test_an_interrupt_between_renames_hides_no_output(output, monkeypatch, renames):
    """The interrupt comes right after a rename has worked, before the next line runs."""
    (output / "preview.png").touch()
    rename, done = Path.rename, []

    def interrupted(self, other):
        rename(self, other)
        done.append(self)
        if len(done) == renames:
            raise KeyboardInterrupt

    monkeypatch.setattr(Path, "rename", interrupted)
    with pytest.raises(KeyboardInterrupt):
        overwrite(output)
    assert hidden(output.parent) == []
    assert (output / MANIFEST).is_file()
    assert (output / "preview.png").exists() == (renames == 1)  # the earlier output, or the new


def test_an_earlier_output_that_cannot_be_put_back_is_kept_and_named(output, monkeypatch):
    rename = Path.rename

    def only_aside(self, other):
        return rename(self, other) if ".old-" in other.name else refuse()

    monkeypatch.setattr(Path, "rename", only_aside)
    with pytest.raises(OutputError, match=r"\.out\.old-.*put back"):
        overwrite(output)
    (kept,) = hidden(output.parent)
    assert (output.with_name(kept) / MANIFEST).is_file()
