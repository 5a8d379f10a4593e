"""The verdict of ``splatseed info``: one line, by what is wrong most."""

from __future__ import annotations

import pytest

from splatseed.commands.capture_check import CaptureCheck, PoseCheck
from splatseed.findings import Finding
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene

INEXACT, WRONG = Finding("inexact-poses", "Off."), Finding("untrainable", "Bad.", "error")


@pytest.mark.parametrize(
    ("doubts", "problems", "verdict"),
    [
        ((INEXACT,), (), "Fits roughly: Off."),
        ((INEXACT,), (WRONG,), "Does not fit: Bad."),
        ((WRONG,), (INEXACT,), "Does not fit: Bad."),
        ((), (INEXACT,), "There are no photographs to check the rest against."),
    ],
)
def test_errors_come_first_and_warnings_fit_roughly(doubts, problems, verdict):
    check = CaptureCheck(None, PoseCheck(0.9, None, doubts), ())
    assert check.verdict(Scene(PointCloud.empty()), problems) == verdict
