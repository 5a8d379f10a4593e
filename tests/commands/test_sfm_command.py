"""``splatseed sfm``: that the words reach the reconstruction, and its report the user.

What the reconstruction does is tested in test_sfm.
"""

from __future__ import annotations

import pytest

from splatseed.commands import sfm
from splatseed.sfm import SfmReport

LOST = tuple(f"lost{i}.jpg" for i in range(7))


@pytest.fixture
def called(monkeypatch, tmp_path):
    """What the two reconstructions were called with, in place of running them."""
    calls = {}
    report = SfmReport(tmp_path / "out", 13, 20, LOST, 1234, 5.5, 0.61, {"features": 1.0})

    def record(name):
        def stand_in(*args, **kwargs):
            calls[name] = (args, kwargs)
            return report

        return stand_in

    for name in ("reconstruct", "triangulate"):
        monkeypatch.setattr(sfm, name, record(name))
    return calls


def test_words_reach_the_reconstruction(called, tmp_path, splatseed):
    words = ["--matcher", "sequential", "--no-shared-camera", "--threads", 2, "--overwrite"]
    run = splatseed("sfm", tmp_path, "-o", tmp_path / "out", "--seed", 3, *words)
    assert (run.code, run.err) == (0, "")
    args, kwargs = called["reconstruct"]
    assert args == (tmp_path, tmp_path / "out")
    assert kwargs["matcher"] == "sequential"
    assert not kwargs["shared_camera"]
    assert (kwargs["threads"], kwargs["seed"], kwargs["overwrite"]) == (2, 3, True)


def test_the_photographs_are_counted_by_folder_first(called, tmp_path, splatseed, capsys):
    splatseed("sfm", tmp_path, "-o", tmp_path / "out")
    tell = called["reconstruct"][1]["on_photos"]
    tell(["a.png", "b.png"], {})
    tell(["scene/images/a.png", "run/render.png", "scene/images/b.png"], {"of grey": ["run/d.png"]})
    told = capsys.readouterr()
    assert told.out == "note: Left out: 1 image of grey, run/d.png.\n"
    assert told.err.splitlines() == [
        f"2 photographs in {tmp_path}",
        f"3 photographs in {tmp_path}: 2 in scene/images, 1 in run",
    ]


def test_known_poses_are_triangulated(called, room, tmp_path, splatseed):
    run = splatseed("sfm", room / "images", "--poses-from", room, "-o", tmp_path / "out")
    assert run.code == 0
    (_, poses, _), _ = called["triangulate"]
    assert len(poses.images) == 12
    assert "reconstruct" not in called


@pytest.mark.usefixtures("called")
def test_the_report_is_told(tmp_path, splatseed):
    out = splatseed("sfm", tmp_path, "-o", tmp_path / "out").out
    for text in ("13 of 20", "1,234", "mean 5.50 images", "mean 0.610 px", "and 2 more"):
        assert text in out
    assert f"splatseed upsample {tmp_path / 'out'} " in out
