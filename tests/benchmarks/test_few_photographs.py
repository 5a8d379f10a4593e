"""The benchmark of few photographs: which are trained on and scored, and both commands."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image as PillowImage

pytest.importorskip("torch", reason="training needs PyTorch")

import splatseed as ss
from splatseed.camera import Intrinsics
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io.llff import POSES
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.synthetic.capture import photograph_room, write_capture
from splatseed.synthetic.room import build_room, orbit_cameras

from ..io.test_llff import rows_of

MODULES = ("few_photographs",)
FULL = 8
"""How much larger the full photographs are."""


def scene_of(count):
    lens = Intrinsics(1, "PINHOLE", 504, 378, (400.0, 400.0, 252.0, 189.0))
    pose = np.array([1.0, 0, 0, 0]), np.zeros(3)
    images = tuple(Image(f"image{i:03d}.png", i + 1, lens, *pose) for i in reversed(range(count)))
    return Scene(PointCloud.empty(), images, (lens,))


def numbers(names):
    return sorted(int(name[5:8]) for name in names)


@pytest.mark.parametrize(
    ("count", "views", "train"),
    [
        # fern, 17 that are not tested: 0, 8, 16; and 0, 3.2, 6.4, 9.6, 12.8, 16 of them.
        (20, 3, [1, 10, 19]),
        (20, 6, [1, 4, 7, 12, 15, 19]),
        # flower, 29: every 3.5th, so 4, 10, 18 and 24 are ties.
        (34, 9, [1, 5, 9, 12, 17, 21, 25, 28, 33]),
        # horns, 54: 26.5 is a tie.
        (62, 3, [1, 30, 61]),
        # leaves, 22: 10.5 is a tie.
        (26, 3, [1, 12, 25]),
    ],
)
def test_the_official_split(bench, count, views, train):
    split = bench.few_photographs.choose(scene_of(count), views, validation=False)
    assert numbers(split.test) == list(range(0, count, 8))
    assert numbers(split.train) == train


def test_validation_views_are_neither_tested_nor_trained(bench):
    choose = bench.few_photographs.choose
    split = choose(scene_of(20), 12, validation=True)
    assert len(split.train) == 12
    assert numbers(split.train | split.test) == [i for i in range(20) if i % 8]
    split = choose(scene_of(100), 3, validation=True)
    assert (len(split.train), len(split.test)) == (3, 16)
    assert not split.train & split.test
    assert not {i for i in numbers(split.train | split.test) if i % 8 == 0}


def test_views_json_goes_first_and_its_capture_has_no_test_photographs(bench):
    chosen = {"train": ["image000.png", "image007.png"], "validate": ["image003.png"]}
    scene, listed = scene_of(10), {"2": chosen}
    split = bench.few_photographs.choose(scene, 2, validation=True, listed=listed)
    assert [numbers(part) for part in (split.train, split.test)] == [[0, 7], [3]]
    split = bench.few_photographs.choose(scene, 4, validation=True, listed=listed)
    assert [numbers(part) for part in (split.train, split.test)] == [
        [0, 3, 6, 9], [1, 2, 4, 5, 7, 8],
    ]  # fmt: skip
    with pytest.raises(ParameterError, match="expected 1 to 10 views"):
        bench.few_photographs.choose(scene, 4, validation=False, listed=listed)


@pytest.mark.parametrize(("views", "validation"), [(8, True), (9, False), (0, False)])
def test_too_few_photographs_are_one_error(bench, views, validation):
    with pytest.raises(ParameterError, match=f"expected 1 to {8 - validation} views.*{views}"):
        bench.few_photographs.choose(scene_of(10), views, validation=validation)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A COLMAP scene, and the same as LLFF's scenes are downloaded."""
    root, rng = tmp_path_factory.mktemp("few"), np.random.default_rng(0)
    room = photograph_room(build_room(rng), orbit_cameras(60, 64, 48)[:10], rng)
    write_capture(room, root / "room")
    scene, folder = ss.load_scene(root / "room"), root / "nerf_llff_data" / "fern"
    for each in ("images", "images_8"):
        (folder / each).mkdir(parents=True)
    shutil.copytree(root / "room/sparse", folder / "sparse")
    for i, image in enumerate(sorted(scene.images, key=lambda each: each.name)):
        shutil.copy(image.path, folder / f"images_8/image{i:03d}.png")
        black = PillowImage.new("RGB", (64 * FULL, 48 * FULL))
        black.save(folder / f"images/IMG_{4026 + i}.JPG")
    np.save(folder / POSES, rows_of(scene, FULL))
    return root


@pytest.fixture
def started(bench, monkeypatch):
    """The runs that a command starts, here instead of in processes of their own."""
    runs = []

    def call(function, *, threads, **arguments):
        assert function == "benchmarks.few_photographs:run"
        assert threads >= 1
        runs.append(arguments)
        return bench.few_photographs.run(**json.loads(json.dumps(arguments)))

    monkeypatch.setattr(bench.few_photographs, "call", call)
    return runs


def rows_in(text):
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines]


def test_the_command_on_the_data_set_as_it_is_downloaded(
    bench, made, started, monkeypatch, tmp_path, capsys
):
    few = bench.few_photographs
    monkeypatch.setattr(few, "has_lpips_weights", lambda: False)
    options = few.Options(
        made / "nerf_llff_data", views=(3,), max_steps=20, output=tmp_path / "out"
    )
    few.main(options)
    (path,) = (tmp_path / "out").glob("*.json")
    kept = json.loads(path.read_text())
    assert (kept["scene"], kept["views"], kept["seed"], kept["steps"]) == ("fern", 3, 0, 20)
    assert [numbers(kept[part]) for part in ("train", "scored")] == [[1, 5, 9], [0, 8]]
    assert [*kept["per_image"]] == kept["scored"]
    assert any("64 x 48" in each for each in kept["findings"])  # not the full, black photographs
    assert any("no points to start from" in each for each in kept["findings"])
    assert kept["psnr"] > 12
    header, _, fern, mean = rows_in(capsys.readouterr().out)
    assert header[:4] == ["scene", "PSNR, dB", "SSIM", "LPIPS (VGG)"]
    assert fern[:4] == ["fern", f"{kept['psnr']:.2f}", f"{kept['ssim']:.3f}", "not installed"]
    assert mean == ["mean of 1", *fern[1:]]

    few.main(options)
    assert len(started) == 1
    assert rows_in(capsys.readouterr().out)[2] == fern
    monkeypatch.setattr(few, "_source_digest", lambda: "another")
    monkeypatch.setattr(few, "run", lambda **_: {**kept, "psnr": 30.0})
    few.main(options)
    assert len(started) == 2
    assert rows_in(capsys.readouterr().out)[2][1] == "30.00"
    digests = iter("ab")
    monkeypatch.setattr(few, "_source_digest", lambda: next(digests))
    with pytest.raises(few.SplatseedError, match="source as it was; found changes"):
        few.main(options)
    assert len([*(tmp_path / "out").glob("*.json")]) == 2


def test_captures_are_scored_on_validation_views(
    bench, made, started, monkeypatch, tmp_path, capsys
):
    def run(folder, train, scored, options):
        scene = bench.few_photographs._read(folder)
        assert not len(scene.points)
        assert scene.tracks is scene.depths is None
        assert not any(image.observations for image in scene.images)
        quality = options["seed"] + len(train)
        numbers = dict.fromkeys(("seconds", "processor", "seeds", "gaussians"), 1)
        return {"psnr": 20.0 + quality, "ssim": 0.5, "lpips": 0.25, "steps": 1500, **numbers}

    monkeypatch.setattr(bench.few_photographs, "run", run)
    options = bench.few_photographs.Options(
        captures=(made / "room",), views=(3, 5), repeats=2, long_side=40, output=tmp_path / "out"
    )
    bench.few_photographs.main(options)
    assert [(each["options"]["seed"], len(each["train"])) for each in started] == [
        (0, 3), (0, 5), (1, 3), (1, 5),
    ]  # fmt: skip
    assert {each["options"]["long_side"] for each in started} == {40}
    tests = {"view_000.png", "view_008.png"}
    assert not any(tests & {*each["train"], *each["scored"]} for each in started)
    out = capsys.readouterr().out
    assert "### 5 photographs, validation views; 1,500 steps, 2 run(s)" in out
    assert [row[1:4] for row in rows_in(out)[2:4]] == [
        ["23.50 ± 0.71", "0.500 ± 0.000", "0.250 ± 0.000"]
    ] * 2


def test_what_is_missing_is_one_error(bench, made, tmp_path):
    few, data = bench.few_photographs, made / "nerf_llff_data"
    for options in (few.Options(), few.Options(data, captures=(made / "room",))):
        with pytest.raises(ParameterError, match="`--llff` or `--captures`"):
            few.main(options)
    for options in (few.Options(data, scenes=("room",)), few.Options(tmp_path)):
        with pytest.raises(SceneNotFoundError, match=r"in .*, each with poses_bounds.npy"):
            few.main(options)
    shutil.copytree(data, tmp_path / "data")
    shutil.rmtree(tmp_path / "data/fern/images_8")
    with pytest.raises(SceneNotFoundError, match="images_8 in"):
        few.main(few.Options(tmp_path / "data", output=tmp_path / "out"))
