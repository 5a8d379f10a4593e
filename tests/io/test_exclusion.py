"""Photographs that the user leaves out, by names and patterns."""

from __future__ import annotations

import json

import pytest

from splatseed import load_scene, write_scene
from splatseed.errors import ParameterError, SceneNotFoundError, UnknownNameError
from splatseed.io.exclusion import EXCLUDED, exclude, matching_names

NAMES = ["left/IMG_0001.JPG", "left/IMG_0012.JPG", "right/IMG_0001.JPG", "a[1].png", "für.jpg"]


@pytest.mark.parametrize(
    ("pattern", "chosen"),
    [
        ("left/IMG_0001.JPG", NAMES[:1]),
        ("IMG_0001.JPG", [NAMES[0], NAMES[2]]),  # a file's own name, in any folder
        ("IMG_0012", NAMES[1:2]),  # without its suffix
        ("IMG_00*", NAMES[:3]),
        ("left/*", NAMES[:2]),
        ("IMG_000?.JPG", [NAMES[0], NAMES[2]]),
        ("a[1].png", NAMES[3:4]),  # a name before it is a pattern
        ("[!l]*/*.JPG", NAMES[2:3]),
        ("SCENE/images/left/IMG_0012.JPG", NAMES[1:2]),  # a path, as shells complete it
        ("fu\u0308r.jpg", NAMES[4:]),  # as macOS spells it
    ],
)
def test_names_and_patterns(pattern, chosen):
    assert matching_names(NAMES, [pattern]) == {*chosen}
    assert matching_names(NAMES, pattern) == {*chosen}


def test_a_text_file_holds_patterns(tmp_path):
    path = tmp_path / "blurred.txt"
    path.write_text("a[[]1].png\n\n  right/*  \n")
    assert matching_names(NAMES, [str(path)]) == {NAMES[2], NAMES[3]}
    path.write_text("a.png\n")
    with pytest.raises(
        ParameterError, match=r"found 'a\.png' in .*blurred\.txt, which matches none"
    ):
        matching_names(NAMES, [str(path)])
    with pytest.raises(SceneNotFoundError, match="text file of names"):
        matching_names(NAMES, [str(tmp_path / "none.txt")])


def test_a_pattern_that_matches_none_is_an_error_with_names():
    with pytest.raises(
        ParameterError, match=r"such as a\[1\]\.png, für\.jpg, left/IMG_0001"
    ) as told:
        matching_names(NAMES, ["IMG_00*", "img_00*"])
    assert told.value.found == "'img_00*', which matches none of 5"


def test_an_output_has_neither_their_cameras_nor_observations(room, tmp_path):
    names = sorted(image.name for image in room.images)
    scene = exclude(room, [names[2], "*_003.png"])
    assert scene.absent == (names[2], names[3])
    assert [(each.kind, each.subjects) for each in scene.findings] == [(EXCLUDED, scene.absent)]
    assert [im.name for im in scene.split(2)[0]] == [
        im.name for im in room.split(2)[0] if im.name not in scene.absent
    ]
    report = write_scene(scene, tmp_path / "out")
    assert "broken-references" not in {each.kind for each in report.findings}
    again = load_scene(tmp_path / "out")
    assert sorted(image.name for image in again.images) == sorted({*names} - {*scene.absent})
    assert {*again.absent} == {*scene.absent}
    gone = [room[name].image_id for name in scene.absent]
    assert not {*gone} & {*again.tracks.image_ids.tolist()}
    kept = sum(image_id not in gone for image_id in room.tracks.image_ids.tolist())
    assert again.tracks.lengths.sum() == kept
    assert exclude(again, [names[2]]) is again  # it is absent already
    with pytest.raises(ParameterError, match="match all"):
        exclude(room, ["*"])
    with pytest.raises(UnknownNameError):
        room.without(["none.png"])


def test_lists_of_a_split_may_name_absent_images(room, tmp_path):
    names = sorted(image.name for image in room.images)
    write_scene(exclude(room, names[:1]), tmp_path / "out")
    (tmp_path / "out" / "test_list.txt").write_text("\n".join(names[:2]))
    scene = load_scene(tmp_path / "out")
    assert scene.listed.test == {names[1]}
    assert "unknown-names-in-split" not in {each.kind for each in scene.findings}


def test_the_commands_record_it(room_path, splatseed, tmp_path):
    run = splatseed("info", room_path, "--exclude", "view_001*", "--exclude", "view_002", "--json")
    assert json.loads(run.out)["images"] == len(load_scene(room_path).images) - 2
    text = splatseed("info", room_path, "--exclude", "view_00[12]*").out
    assert "2 photographs are left out: view_001.png, view_002.png" in text
    lines = [line for line in text.splitlines() if "splatseed train" in line]
    assert lines
    assert all(f"{room_path} --exclude 'view_00[12]*' " in line for line in lines)
    out = tmp_path / "out"
    words = ("--method", "linear", "--exclude", "view_001.png", "-o", out)
    splatseed("upsample", room_path, *words)
    facts = json.loads((out / "splatseed.json").read_text())
    assert facts["exclude"] == facts["absent"] == ["view_001.png"]
