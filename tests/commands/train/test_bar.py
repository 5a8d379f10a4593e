"""The progress line of training fits what the terminal has."""

from __future__ import annotations

from io import StringIO

import pytest
from rich.progress import Progress

from splatseed.commands.train import bar_columns
from splatseed.console import LiteralConsole

LINE = "PSNR 27.31, test 26.05 dB  1,234,567 Gaussians  12.3 steps/s  loss 0.0412"


@pytest.mark.parametrize(("width", "says"), [(200, LINE), (80, "PSNR 27.31, test 26."), (48, "P")])
def test_steps_and_time_left_are_always_there(width, says):
    out = StringIO()
    console = LiteralConsole(file=out, force_terminal=True, width=width, color_system=None)
    bar = Progress(*bar_columns(), console=console, expand=True, auto_refresh=False)
    bar.add_task(LINE, total=30_000, completed=12_345)
    console.print(bar.get_renderable())
    (line,) = out.getvalue().splitlines()
    assert len(line) <= width
    assert "12345/30000" in line
    assert "-:--:--" in line  # the time left, before there is a speed
    assert says in line
    assert ("…" in line) == (width < 200)
