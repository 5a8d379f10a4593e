"""``splatseed sfm``: that the words reach the reconstruction, and its report the user.

What the reconstruction does is tested in tests/sfm.
"""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest

from splatseed.checkup.pose_accuracy import PoseErrorEstimate
from splatseed.commands import sfm
from splatseed.io import load_scene
from splatseed.io.load import with_own_depths
from splatseed.sfm import Refinement, Settings, SfmReport
from splatseed.sfm.photos import find_photos
from splatseed.sfm.refinement import unrefined_finding

from ..io.phone_exports import write_polycam, write_scanner_app

LOST = tuple(f"lost{i}.jpg" for i in range(10))
FACTS = (1234, 5.5, 0.61, {"features": 1.0})


@pytest.fixture
def called(monkeypatch, tmp_path):
    """What the reconstruction was called with, in place of running it."""
    calls = {}
    changes = [
        Refinement(True, 0.162, 0.162),
        Refinement(False, 9.44, 0.16, 0.04, 0.113, 1.24, 3.66, ("a.jpg",)),
    ]

    def reconstruct(*args, **kwargs):
        calls.update(args=args, **kwargs)
        change = changes.pop() if kwargs.get("refine_poses") else None
        unrefined = unrefined_finding(20, change.excluded) if change else None
        report = SfmReport(tmp_path / "out", 13, 20, LOST, *FACTS, change, num_pairs=77)
        return replace(report, findings=(unrefined,) if unrefined else ())

    monkeypatch.setattr(sfm, "reconstruct", reconstruct)
    monkeypatch.setattr(sfm, "_pose_error", lambda *_: calls.get("error"))
    return calls


def test_words_reach_the_reconstruction_and_its_report_the_user(called, tmp_path, splatseed):
    words = ["--matcher", "sequential", "--threads", 2, "--overwrite", "--seed", 3, "--resume"]
    run = splatseed("sfm", tmp_path, "-o", tmp_path / "out", "--no-shared-camera", *words)
    assert (run.code, run.unexpected) == (0, "")
    settings = Settings("sequential", seed=3, threads=2)
    assert called["args"] == (tmp_path, tmp_path / "out", settings)
    assert not called["shared_camera"]
    assert called["overwrite"]
    assert called["resume"]
    for text in ("77 of 190", "13 of 20", "1,234", "mean 5.50 images", "mean 0.610 px"):
        assert text in run.out
    assert "and 2 more" in run.err
    assert f"splatseed info {tmp_path / 'out'}" in run.out


@pytest.mark.parametrize("exact", [True, False])
def test_poses_that_photographs_do_not_fit_are_pointed_out(exact, called, tmp_path, splatseed):
    called["error"] = PoseErrorEstimate(0.2 if exact else 2.2, 0.17, exact, 757)
    _, out, err = splatseed("sfm", tmp_path, "-o", tmp_path / "out")
    verdict = "0.2 px (0.17 degrees) at 757 px a side: exact, at most 0.5 px"
    assert (verdict if exact else "2.2 px (0.17 degrees) at 757 px a side: above 0.5 px") in out
    assert ("do not fit these poses" in err) != exact


def test_poses_are_measured_by_the_photographs(room_of):
    report = SfmReport(room_of(16, 160, 120).path, 16, 16, (), *FACTS)
    error = sfm._pose_error(report, lambda *_: None)
    assert error.exact
    assert error.px < 0.2


def test_the_photographs_are_counted_by_folder(called, tmp_path, splatseed, capsys):
    splatseed("sfm", tmp_path, "-o", tmp_path / "out")
    called["on_photos"](
        ["scene/a.png", "run/b.png", "scene/c.png"], {"of grey": ["run/d.png"]}, "1 camera"
    )
    told = capsys.readouterr()
    photographs = f"3 photographs in {tmp_path}: 2 in scene, 1 in run\n1 camera\n"
    assert told.err == f"{photographs}note: Left out: 1 image of grey (run/d.png).\n"


def test_an_apps_export_gives_its_photographs_and_its_poses_are_pointed_out(
    called, room, tmp_path, splatseed, capsys
):
    scene = with_own_depths(load_scene(room))
    scanner = write_scanner_app(scene, tmp_path / "scanner")
    for name in ("textured_output.jpg", "thumb_00000.jpg"):
        shutil.copy(scanner / "frame_00000.jpg", scanner / name)
    polycam = write_polycam(scene, tmp_path / "polycam")
    shutil.copytree(room / "images", polycam / "keyframes/images", dirs_exist_ok=True)
    for export, photographs in (
        (scanner, scanner),
        (polycam, polycam / "keyframes/corrected_images"),
    ):
        assert splatseed("sfm", export, "-o", tmp_path / "out").code == 0
        assert called["args"][0] == photographs
        photos, left_out = find_photos(photographs)
        assert len(photos) == 12
        called["on_photos"](list(photos), left_out, "")
        told = capsys.readouterr()
        assert told.err.count("Left out") == (export == scanner)
        assert (
            f"{export} has poses of 12 photographs, and depth maps: splatseed upsample {export} "
            in told.err
        )
        assert f"12 photographs in {photographs}\n" in told.err
    left_out = find_photos(scanner)[1]
    assert [len(names) for names in left_out.values()] == [12, 12, 2]
    splatseed("sfm", room / "images", "-o", tmp_path / "out")
    called["on_photos"](["view_000.png"], {}, "")
    assert "upsample" not in capsys.readouterr().err


def test_known_poses_are_triangulated_and_refined_when_asked(
    called, room, tmp_path, splatseed, capsys
):
    words = ("sfm", room / "images", "--poses-from", room, "-o", tmp_path / "out")
    assert splatseed(*words).code == 0
    assert len(called["poses_from"].images) == 12
    assert "camera_model" not in called
    names = [image.name for image in called["poses_from"].images]
    called["on_photos"](names[2:], {"of an unsupported format": [names[1]]}, "")
    assert f"; 1 pose without a photograph ({names[0]})." in capsys.readouterr().err
    _, moved, err = splatseed(*words, "--refine-poses")
    for text in ("9.440 px", "0.160 px", "0.04 units", "0.113", "1.24 degrees", "3.66"):
        assert text in moved
    assert "stay as given: fewer than 10 points are seen in a.jpg." in err
    assert "kept as given" in splatseed(*words, "--refine-poses").out
