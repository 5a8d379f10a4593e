"""What ``info`` and ``upsample SCENE`` say is to be done; they write nothing."""

from __future__ import annotations

import pytest

from splatseed.cli import main
from splatseed.synthetic import make_capture, write_capture


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    path = tmp_path_factory.mktemp("made") / "room"
    return write_capture(make_capture(0, num_views=9, width=64, height=48), path)


@pytest.mark.parametrize("verb", ["info", "upsample"])
def test_a_full_cloud_is_to_be_left_as_it_is(room, verb, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    main([verb, str(room), "--budget", "60", "--max-steps", "500"])
    out = capsys.readouterr().out
    assert "leave the points as they are" in out
    assert "no room for more" in out
    assert "60 Gaussians at most, 500 steps, strategy grow" in out
    assert "splatseed train" in out
    assert "--seeds scene" in out
    assert not list(tmp_path.iterdir())


def test_a_sparse_cloud_is_to_be_added_to(room, capsys):
    main(["info", str(room)])
    out = capsys.readouterr().out
    assert "add points by method auto" in out
    assert "room for" in out
    assert "of the cells of a coarse grid over the pictures." in out
    assert f"splatseed upsample {room} --budget" in out


def test_a_trial_is_of_the_plan_that_was_given(room, capsys):
    main(["upsample", str(room), "--budget", "500", "--max-steps", "20000"])
    rho = f"{500 / (64 * 48):.3g}rho"
    assert f"--minutes 30 --budget {rho} --max-steps 20000\n" in capsys.readouterr().out
    main(["upsample", str(room)])
    assert "--minutes 30\n" in capsys.readouterr().out


def test_only_unknown_options_are_called_unknown(room, capsys):
    for words in (["--max-steps", "9"], ["--max-steps=9"]):
        with pytest.raises(SystemExit):
            main(["upsample", str(room), *words, "--strategy", "default"])
        said = " ".join(capsys.readouterr().err.split())
        assert "found unrecognized option --strategy." in said


def test_upsample_tries_stereo_before_it_says_what_to_do(room, capsys):
    main(["upsample", str(room)])
    out = capsys.readouterr().out
    assert "Stereo finds a confirmed depth for" in out
    assert "splatseed tune" in out
