"""Bad input: exit code 2, an error that names the file, option or value, and nothing written.

``COMMANDS`` lists commands with what their error must name; ``refused`` checks the rest for all.
"""

from __future__ import annotations

import errno
import json
import re
import shutil
import sys
import warnings
import zipfile
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PilImage

torch = pytest.importorskip("torch", reason="some verbs import PyTorch")

from splatseed.bench.runs import record_plan
from splatseed.cli import VERBS
from splatseed.commands import info
from splatseed.errors import OutputError, SceneFormatError
from splatseed.io import colmap, load_scene
from splatseed.io.ply import write_ply
from splatseed.io.staging import MANIFEST, atomic_file, output_folder
from splatseed.pointcloud import PointCloud
from splatseed.splat.formats import write_gaussians
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.training.folder import RunFolder
from splatseed.training.settings import TrainSettings
from splatseed.training.state import load_checkpoint, make_strategy

from ..command_line import parser_of


def _refused(run, *named):
    """Check the rules that all errors obey, and what this one names; returns its text."""
    assert run.code == 2, run
    assert "Traceback" not in run.out + run.err
    err = run.unexpected
    said = " ".join(re.sub("[│╭╮╰╯─]", " ", err).split())  # tyro's boxes
    if err.startswith("error: "):
        assert err.startswith("error: expected ")
        assert err.count("\n") == 1
        assert "; found " in err
    else:
        assert "--help" in said
    for text in named:
        assert str(text) in said, run
    return said


def _contents(folder):
    return {path: path.is_file() and path.read_bytes() for path in folder.rglob("*")}


# The table ----------------------------------------------------------------------------------------

OUT = ("-o", "OUT")
UP = ("upsample", "ROOM", *OUT)
LIFT = (*UP, "--method", "depth")
MLS = (*UP, "--method", "mls")
TRAIN = ("train", "ROOM", *OUT)
DEPTH = ("depth", "ROOM", *OUT)
SFM = ("sfm", "ROOM/images", *OUT)
BENCH = ("bench", "--scenes", "demo:", *OUT)
EVALUATE = ("evaluate", "model.ply", "--scene", "ROOM")
FLIGHT = ("flight", "model.ply", "-o", "a.mp4")

COMMANDS = [
    (("upsmaple",), "upsample?"),
    (("Info",), "info?"),
    (("--verison",), "--version?"),
    (("info",), "PATH"),
    (("info", "nowhere"), "nowhere"),
    (("info", "nowhere", "--bogus"), "--bogus"),
    (("info", "ROOM", "b", "c"), "b, c"),
    (("info", "film.mp4"), "splatseed sfm film.mp4"),
    (("info", "junk.r3d"), "junk.r3d"),
    (("info", "RECORD3D"), "RECORD3D/metadata.json"),
    (("info", "STRAY"), "STRAY/rgb.mp4"),
    (("info", "PHONE"), "cameraPoseARFrame in PHONE/frame_00000.json; found 12 numbers"),
    (("upsample", "PHONE/bare", *OUT), "All Data"),
    (("train", "POLYCAM", *OUT), "Developer mode"),
    (("info", "ROOM", "--picture", "a.png"), "--depth DIR"),
    (("info", "ROOM", "--depth-kind", "ray"), "--depth DIR"),
    (("info", "ROOM", "--depth-scale", "5"), "--depth DIR"),
    (("info", "ROOM", "--depth", "ROOM", "--depth-scale", "0"), "scale"),
    (("upsample", "ROOM"), "-o"),
    (("upsample", "ROOM", "-o", "more.ply"), "-o more"),
    ((*UP, "--jobs", "0"), "--jobs"),
    ((*UP, "--budget", "1e-9rho"), "1e-9rho"),
    ((*UP, "--cover", "8"), "--auto.cell"),
    ((*UP, "--auto.grid", "0"), "grid"),
    ((*UP, "--method", "magic"), "pip install"),
    ((*UP, "--format", "nerf"), "nerf"),
    ((*UP, "--ratoi", "4"), "--ratio"),
    ((*UP, "--k", "9"), "--mls.k"),
    ((*MLS, "--mls.k", "2"), "mls.k"),
    ((*MLS, "--mls.frame", "up"), "--mls.frame"),
    ((*MLS, "--linear.k", "2"), "--linear.k"),
    ((*MLS, "--cover", "0"), "--cover"),
    ((*MLS, "--ratio", "0.5"), "ratio"),
    ((*MLS, "--ratio", "nan"), "ratio"),
    ((*MLS, "--ratio", "1e12"), "4,294,967,296"),
    ((*MLS, "--num-points", "10"), "10"),
    ((*MLS, "--num-points", "500k"), "--num-points"),
    ((*MLS, "--ratio", "2", "--num-points", "5000"), "both"),
    ((*LIFT, "--depth", "nowhere"), "nowhere"),
    ((*LIFT, "--depth-kind", "ray"), "--depth DIR"),
    ((*LIFT, "--depth", "ROOM", "--depth-scale", "0"), "scale"),
    ((*LIFT, "--depth", "ROOM", "--depth.tolerance", "2"), "tolerance"),
    ((*LIFT, "--depth.region", "0.5"), "--depth.central-fraction"),
    ((*TRAIN, "--max-step", "4"), "--max-steps"),
    ((*TRAIN, "--strategy", "defalt"), "--strategy"),
    ((*TRAIN, "--data-factor", "1000"), "--data-factor"),
    ((*TRAIN, "--long-side", "5"), "--long-side"),
    ((*TRAIN, "--long-side", "48", "--data-factor", "2"), "--long-side or --data-factor"),
    ((*TRAIN, "--budget", "1"), "--budget"),
    ((*TRAIN, "--budget", "many"), "many"),
    ((*TRAIN, "--config", "nowhere.toml"), "nowhere.toml"),
    ((*TRAIN, "--config"), "--config"),
    ((*EVALUATE, "--data-factor", "0"), "--data-factor"),
    ((*EVALUATE, "--test-every", "1"), "--test-every"),
    (("evaluate", "model.ply"), "--scene"),
    ((*DEPTH, "--max-size", "5"), "--max-size"),
    ((*DEPTH, "--depth-kind", "z"), "--depth-kind"),
    ((*DEPTH, "--model", "some", "--colmap"), "--colmap"),
    ((*DEPTH, "--model", "nobody/Depth-Nothing-hf"), "nobody/Depth-Nothing-hf"),
    ((*DEPTH, "--model", "gone.onnx"), "gone.onnx"),
    (("sfm", "x", "-o"), "-o"),
    (("sfm", "nowhere", *OUT), "nowhere"),
    ((*SFM, "--frames", "5"), "--frames"),
    ((*SFM, "--device", "abacus"), "abacus"),
    ((*SFM, "--camera-model", "FOO"), "FOO"),
    ((*SFM, "--refine-poses"), "--poses-from"),
    ((*SFM, "--poses-from", "ROOM", "--camera-model", "PINHOLE"), "--camera-model"),
    (("bench", "reprot", "B"), "report?"),
    ((*BENCH, "--repeats", "0"), "--repeats"),
    ((*BENCH, "--long-side", "0"), "--long-side"),
    (("demo", "--views", "2"), "views"),
    (("demo", "--train-steps", "-1"), "--train-steps"),
    ((*MLS, "--cloud", "SCAN"), "--cloud"),
    ((*MLS, "--gaussians", "start.splat"), "start.splat"),
    ((*MLS, "--gaussians", "OUT/start.ply"), "OUT/start.ply"),
    ((*MLS, "--gaussians", "model.ply"), "--overwrite"),
    ((*MLS, "--refine-poses", "--depth-scale", "2"), "--depth DIR"),
    ((*LIFT, "--depth", "ROOM", "--depth-scale", "5", "--depth.no-align"), "scale"),
    ((*LIFT, "--depth", "ROOM", "--depth-kind", "inverse"), "depth"),
    ((*LIFT, "--depth", "ROOM", "--ratio", "300"), "points"),
    ((*UP, "--method", "cloud"), "--cloud FILE"),
    ((*UP, "--transform", "x.txt"), "--cloud FILE"),
    ((*UP, "--align"), "--cloud FILE"),
    ((*UP, "--cloud", "none.laz"), "none.laz"),
    ((*UP, "--cloud", "SCAN", "--memory", "500M"), "--memory 6"),
    ((*UP, "--cloud", "SCAN", "--memory", "a lot"), "a lot"),
    ((*UP, "--cloud", "SCAN", "--align", "--transform", "t.txt"), "--align"),
    ((*UP, "--cloud", "SCAN", "--transform", "none.txt"), "none.txt"),
    (("evaluate", "ROOM"), "splatseed train ROOM"),
    ((*EVALUATE, "--lpips-weights", "nowhere"), "nowhere"),
    ((*EVALUATE, "--data-factor", "40"), "--data-factor"),
    (("evaluate", "scan.npz", "--scene", "ROOM"), "scan.npz"),
    (("evaluate", "junk.ply", "--scene", "ROOM"), "junk.ply"),
    (("evaluate", "nothing", "--scene", "ROOM"), "nothing"),
    (("view", "nowhere"), "nowhere"),
    (("view", "ROOM", "--host", "256.0.0.1"), "--host"),
    (("view", "ROOM", "--port", "99999"), "--port"),
    (("view", "ROOM", "--compare", "nowhere", "--port", "0"), "nowhere"),
    (("flight", "ROOM", "-o", "a.mp4"), "splatseed train ROOM"),
    (("flight", "model.ply", "-o", "a.avi"), ".mp4"),
    (("flight", "model.ply", "-o", "x" * 300 + ".mp4"), "x" * 300),
    ((*FLIGHT, "--size", "0x9"), "--size"),
    ((*FLIGHT, "--seconds", "0"), "--seconds"),
    ((*FLIGHT, "--path", "none.json"), "none.json"),
    ((*FLIGHT, "--transform", "gsplat"), "--path"),
    ((*FLIGHT, "--compare", "nowhere"), "nowhere"),
    (("export", "nowhere", "-o", "a.spz"), "nowhere"),
    (("export", "model.ply", "-o", "a.glb"), "splat-transform"),
    (("export", "model.ply", "-o", "a.spz", "--crop", "1,2"), "--crop"),
    (("export", "model.ply", "-o", "a.spz", "--min-opacity", "2"), "--min-opacity"),
    ((*SFM, "--frames", "0"), "--frames"),
    ((*SFM, "--poses-from", "ROOM", "--no-shared-camera"), "shared"),
    (("sfm", "film.mp4", *OUT, "--poses-from", "ROOM"), "--poses-from"),
    (("sfm", "film.mp4", *OUT), "film.mp4"),
    (("demo", *OUT, "--training", "only"), "splatseed demo"),
    # Outputs that exist, or lie where none may: TAKEN holds a file of the user's, RUN is a run.
    (("upsample", "ROOM", "-o", "TAKEN"), "TAKEN"),
    (("depth", "ROOM", "-o", "TAKEN", "--overwrite"), "TAKEN"),
    (("train", "ROOM", "-o", "TAKEN"), "TAKEN"),
    (("sfm", "ROOM/images", "-o", "TAKEN", "--overwrite"), "TAKEN"),
    (("undistort", "ROOM", "-o", "TAKEN"), "TAKEN"),
    (("demo", "-o", "TAKEN"), "TAKEN"),
    ((*EVALUATE, "-o", "TAKEN/mine.txt"), "--overwrite"),
    ((*EVALUATE, "-o", "model.ply", "--overwrite"), "model.ply"),
    ((*EVALUATE, "-o", "ROOM/scores.json", "--overwrite"), "ROOM"),
    ((*EVALUATE, "--renders", "TAKEN"), "TAKEN"),
    (("export", "model.ply", "-o", "TAKEN/mine.txt"), ".txt"),
    (("export", "model.ply", "-o", "taken.spz"), "--overwrite"),
    (("export", "model.ply", "-o", "model.ply", "--overwrite"), "model.ply"),
    (("export", "model.ply", "-o", "RUN/out.spz"), "RUN"),
    (("evaluate", "RUN"), "--resume"),
]


NEEDED = {"sfm": "pycolmap", "depth": "transformers", "view": "viser", "flight": "imageio_ffmpeg"}


@pytest.fixture(scope="module")
def things(room, tmp_path_factory) -> Path:
    """A folder of what the words name. Not to be written to."""
    folder = tmp_path_factory.mktemp("things")
    (folder / "junk.ply").write_bytes(b"ply\n")
    write_gaussians(folder / "model.ply", initial_gaussians(load_scene(room).points))
    (folder / "film.mp4").write_bytes(b"\0" * 999)
    (folder / "junk.r3d").write_bytes(b"PK\3\4")
    (folder / "RECORD3D" / "rgb").mkdir(parents=True)
    (folder / "RECORD3D" / "metadata.json").write_text('{"poses": 9}')
    (folder / "STRAY").mkdir()
    for name in ("odometry.csv", "camera_matrix.csv"):
        (folder / "STRAY" / name).touch()
    np.savez(folder / "scan.npz", xyz=np.random.default_rng(0).random((99, 3)))
    (folder / "TAKEN").mkdir()
    (folder / "TAKEN" / "mine.txt").write_text("years")
    (folder / "taken.spz").write_bytes(b"mine")
    for inner in ("PHONE/bare", "POLYCAM/keyframes/images"):
        (folder / inner).mkdir(parents=True)
    for name in ("PHONE/frame_00000.jpg", "POLYCAM/keyframes/images/1.jpg"):
        PilImage.new("RGB", (8, 6)).save(folder / name)
    for name in ("PHONE/frame_00000.json", "PHONE/bare/frame_00000.json"):
        (folder / name).write_text(json.dumps({"cameraPoseARFrame": [1] * 12}))
    _run_folder(folder / "RUN")
    (folder / "RUN" / "point_cloud.ply").unlink()
    return folder


@pytest.fixture
def refused(room, things, tmp_path, monkeypatch, splatseed):
    """Checks that words are refused, where ROOM is a scene and SCAN a cloud."""
    monkeypatch.chdir(shutil.copytree(things, tmp_path, dirs_exist_ok=True))
    before = _contents(tmp_path)

    def check(*words):
        named = {"ROOM": str(room), "SCAN": "scan.npz"}
        run = splatseed(*(re.sub("ROOM|SCAN", lambda each: named[each[0]], w) for w in words))
        assert not run.out or "--depth" in words, run
        assert _contents(tmp_path) == before
        return _refused(run).replace(str(room), "ROOM")

    return check


@pytest.mark.parametrize(
    ("words", "named"),
    COMMANDS,
    ids=lambda each: each if isinstance(each, str) else " ".join(each)[-40:],
)
def test_an_error_names_the_file_option_or_value(words, named, refused):
    if words[0] in NEEDED:
        pytest.importorskip(NEEDED[words[0]])
    assert named in refused(*words)


THINGS = {"sfm": ["ROOM/images"], "bench": BENCH[1:], "evaluate": EVALUATE[1:]}
MODELS = {"flight": "out.mp4", "export": "out.splat"}
ALSO = {"upsample": ["--method", "mls"]}
ANY = {("sfm", "--threads")}
"""Where -1 stands for all."""


@pytest.mark.parametrize("verb", sorted({*VERBS} - {"demo", "view"}))
def test_numbers_have_minimums(verb, refused):
    kind = import_module(f"splatseed.commands.{verb}").Options
    things = ["model.ply"] if verb in MODELS else THINGS.get(verb, ["ROOM"])
    output = [] if verb in {"info", "evaluate", "bench"} else ["-o", MODELS.get(verb, "OUT")]
    for action in parser_of(kind)._actions:
        option = action.option_strings[-1] if action.option_strings else ""
        values = {"INT": ["-1"], "FLOAT": ["-1", "nan"]}.get(str(action.metavar), [])
        for value in [] if (verb, option) in ANY else values:
            said = refused(verb, *things, *ALSO.get(verb, []), *output, f"{option}={value}")
            field = option.removeprefix("--").replace("-", "_")
            assert option in said or field in said or "--depth DIR" in said, said


# Scenes ------------------------------------------------------------------------------------------


def test_too_few_and_unusable_points(rng, tmp_path, splatseed):
    xyz = rng.random((100, 3)).astype(np.float32)
    xyz[[3, 50]], xyz[60] = np.nan, xyz[61]
    for name, some in (("one", xyz[:1]), ("some", xyz)):
        write_ply(tmp_path / f"{name}.ply", PointCloud(some, np.zeros(some.shape, np.uint8)))
    _refused(splatseed("upsample", tmp_path / "one.ply", "-o", tmp_path / "deep/out"), "point")
    assert not (tmp_path / "deep").exists()
    run = splatseed("upsample", tmp_path / "some.ply", "-o", tmp_path / "out", "--ratio", 2)
    assert run.code == 0
    assert "2 points are not finite" in run.err
    assert "2 not finite, 1 duplicate" in run.out
    written = load_scene(tmp_path / "out").points
    assert len(written) == 2 * (100 - 3)
    assert written.finite.all()


PYTHON = re.compile(r"<\w+[.\w]* |0x[0-9a-f]{5}|\bb['\"]|\\x|\b\w+Error\b")
"""What only Python's programmers understand."""
JUNK = {"bytes": bytes([137, 3, 0, 255, 13]) * 40, "text": b"some words\n" * 9, "empty": b""}


@pytest.mark.parametrize("junk", JUNK)
@pytest.mark.parametrize(
    "words",
    [
        "info junk.ply",
        "info room",
        "upsample room -o out",
        "train room -o out --max-steps 1",
        "sfm room/images -o out",
        "depth room -o out",
        "info room --depth maps",
        "info transforms",
        "export junk.ply -o out.splat",
        "evaluate junk.ply --scene room",
        "upsample room -o out --cloud junk.ply",
    ],
)
def test_errors_on_junk_name_nothing_of_python(
    words, junk, own_room, tmp_path, monkeypatch, splatseed
):
    if words.startswith("sfm"):
        pytest.importorskip("pycolmap")
    monkeypatch.chdir(tmp_path)
    own_room.rename("room")
    (tmp_path / "maps").mkdir()
    for image in sorted((tmp_path / "room" / "images").iterdir()):
        (tmp_path / "maps" / f"{image.stem}.npy").write_bytes(JUNK[junk])
        image.write_bytes(JUNK[junk])
    (tmp_path / "transforms").mkdir()
    (tmp_path / "junk.ply").write_bytes(JUNK[junk])
    (tmp_path / "transforms" / "transforms.json").write_bytes(JUNK[junk])
    run = splatseed(*words.split())
    assert not PYTHON.search(run.out + run.err), run
    if words != "info room":  # which lists photographs that cannot be read
        _refused(run)
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("how", ["cut", "flipped", "text", "pickle", "zip"])
def test_a_damaged_checkpoint(how, rng, tmp_path):
    settings, cpu = TrainSettings(strategy="none", backend="cpu"), torch.device("cpu")
    strategy, path = make_strategy(settings, cpu), tmp_path / "file"
    torch.save({"format": 2, "params": {"means": torch.zeros(30, 3)}, "step": 3}, path)
    whole = path.read_bytes()
    for _ in range(20 if how == "flipped" else 1):
        flipped = bytearray(whole)
        for at in rng.integers(0, len(whole), 40):
            flipped[at] ^= int(rng.integers(1, 256))
        pickled = b"\x80\x04cos\nsystem\n(X\x02\x00\x00\x00lstR."
        data = {"cut": whole[: len(whole) // 2], "text": b"junk", "pickle": pickled}
        path.write_bytes(data.get(how, bytes(flipped)))
        if how == "zip":
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("archive/data.pkl", b"(")
        with pytest.raises(SceneFormatError), warnings.catch_warnings(action="error"):
            load_checkpoint(path, strategy, settings.schedule, cpu)


# Outputs -----------------------------------------------------------------------------------------


def test_a_taken_output_is_refused(room, tmp_path, splatseed):
    out = tmp_path / "out"
    assert splatseed("upsample", room, "--method", "mls", "-o", out).code == 0
    before = _contents(tmp_path)
    _refused(splatseed("upsample", room, "-o", out, "--ratio", 2), out, "--overwrite")
    assert _contents(tmp_path) == before


@pytest.mark.parametrize("place", [".", "sparse/0/up", "..", "depths/up"])
def test_the_input_is_no_place_for_the_output(place, own_room, tmp_path, splatseed):
    before = _contents(tmp_path)
    for words in ([], ["--overwrite"], ["--method", "depth", "--depth", own_room / "depths"]):
        run = splatseed("upsample", own_room, "-o", own_room / place, *words)
        _refused(run, own_room)
    assert _contents(tmp_path) == before


def test_a_failed_write_leaves_nothing_and_spares_the_earlier_output(
    room, tmp_path, splatseed, monkeypatch
):
    out = tmp_path / "out"
    assert splatseed("upsample", room, "--method", "mls", "-o", out).code == 0
    before = _contents(tmp_path)

    def write(path, points, tracks=None):
        Path(path).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(colmap, "write_points3d", write)
    for words in (["-o", out, "--overwrite"], ["-o", tmp_path / "deep/out"]):
        _refused(splatseed("upsample", room, "--method", "linear", *words), words[1])
        assert _contents(tmp_path) == before


def test_running_out_of_memory_is_an_error_of_one_line(splatseed, monkeypatch):
    for error, says in (
        (MemoryError(), "found none left."),
        (MemoryError("a lot"), "found a lot."),
        (torch.cuda.OutOfMemoryError("CUDA"), "on the GPU; found none left."),
    ):
        monkeypatch.setattr(info, "run", lambda _, error=error: (_ for _ in ()).throw(error))
        _refused(splatseed("info", "somewhere"), says)


def test_a_link_to_itself(room, tmp_path, splatseed):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for verb in (["upsample", room], ["depth", room], ["train", room]):
        _refused(splatseed(*verb, "-o", tmp_path / "loop"), "loop")
    _refused(splatseed("info", tmp_path / "loop"), "loop")
    with pytest.raises(OutputError, match="loop"), atomic_file(tmp_path / "loop"):
        pass


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_output(room, splatseed, monkeypatch):
    with pytest.raises(OutputError, match="a device"), atomic_file(Path("/dev/full")):
        pass
    with pytest.raises(OutputError, match="a file"), output_folder(Path("/dev/full"), kind="x"):
        pass
    assert Path("/dev/full").is_char_device()
    with Path("/dev/full").open("w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        run = splatseed("info", room)
        full.close = lambda: None  # what is left in its buffer cannot be written
    _refused(run, "No space left on device")


def _run_folder(path):
    RunFolder(path).create({"splatseed": "0"})
    (path / "point_cloud.ply").touch()


def _bench(path):
    record_plan(path, "bench", [], [])
    (path / "plan.toml").touch()


def _notes(path):
    path.mkdir()
    (path / MANIFEST).write_text("{}")
    (path / "thesis.tex").write_text("years")


WRITERS = {
    "upsample": ["ROOM", "--overwrite"],
    "depth": ["ROOM", "--overwrite"],
    "sfm": ["ROOM/images", "--overwrite"],
    "undistort": ["ROOM", "--overwrite"],
    "demo": ["--overwrite"],
    "train": ["ROOM", "--overwrite"],
    "bench": ["--scenes", "ROOM"],
}
"""The last has no --overwrite, as it goes on with what is its own."""


@pytest.mark.parametrize("make", [_run_folder, _bench, _notes])
@pytest.mark.parametrize("verb", WRITERS)
def test_another_kinds_folder_is_refused(make, verb, room, tmp_path, splatseed):
    if (make, verb) in {(_run_folder, "train"), (_bench, "bench")}:
        pytest.skip("its own kind")
    out = tmp_path / "out"
    make(out)
    before = _contents(out)
    words = [word.replace("ROOM", str(room)) for word in WRITERS[verb]]
    _refused(splatseed(verb, *words, "-o", out), out)
    assert _contents(out) == before


# Names -------------------------------------------------------------------------------------------

NAME = "room\x1b[31m:fire:[red]\nx"


@pytest.mark.parametrize("words", [["info"], ["upsample", "--method", "linear"]])
def test_control_characters_of_names_are_escaped(words, room, tmp_path, splatseed):
    scene = shutil.copytree(room, tmp_path / NAME)
    output = [] if words == ["info"] else ["-o", tmp_path / f"out{NAME}"]
    run = splatseed(words[0], scene, *words[1:], *output)
    assert run.code == 0, run
    assert "\x1b" not in run.out + run.err

    assert r"room\x1b[31m:fire:[red]\nx" in run.out
    _refused(splatseed("info", tmp_path / f"no{NAME}"), r"noroom\x1b[31m:fire:[red] x")


def test_a_value_that_a_method_refuses_is_printed_once(splatseed, room, tmp_path):
    words = ("--method", "depth", "--depth.central-fraction", "2", "-o", tmp_path / "out")
    run = splatseed("upsample", room, *words)
    assert run.code == 2
    assert run.err.count("depth.central_fraction above 0 and at most 1") == 1
