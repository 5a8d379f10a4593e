"""``splatseed info --depth``: numbers, the list of images, the picture."""

from __future__ import annotations

import json
import re
import shlex

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.commands.next_steps import number_for
from splatseed.depth.alignment import align
from splatseed.io import find_depths, load_scene
from splatseed.io.depth_maps import depth_folder
from splatseed.synthetic import make_capture, write_capture

ROW = re.compile(r"^(\S+\.\w+) +([\d,]+) +(\S+)(?: +(\S+))? +(\S+%|-)$", re.MULTILINE)


@pytest.fixture(scope="session")
def tour(tmp_path_factory):
    """A room of 15 views: more than are listed. Not to be written to."""
    path = tmp_path_factory.mktemp("tour") / "tour"
    return write_capture(make_capture(0, num_views=15, width=96, height=72), path)


def _rewrite(path, output, change, kind="z", names=None):
    """Depth maps of a capture, each made another one by ``change(index, values)``."""
    scene = load_scene(path)
    depths = find_depths(scene, path / "depths")
    with depth_folder(output, kind) as writer:
        for i, name in enumerate(sorted(depths)):
            if names is None or name in names:
                writer.write(name, np.float32(change(i, depths.read(name).values)))
    return output


def _rows(out):
    return {row[0]: row[1:] for row in ROW.findall(out)}


def _pairs(out):
    lines = [line.strip().split("  ", 1) for line in out.splitlines()]
    return {line[0]: line[1].strip() for line in lines if len(line) == 2}


def test_nothing_follows_from_maps_that_do_not_fit(room, splatseed):
    run = splatseed("info", room, "--depth", room / "depths", "--depth-kind", "inverse")
    assert "12 of 12 depth maps cannot be aligned" in run.out
    assert "--method depth" not in run.out
    assert "by method depth" not in run.out
    assert _pairs(run.out)["depth maps"] == "12"


def test_true_depth_fits(room, splatseed):
    run = splatseed("info", room, "--depth", room / "depths")
    assert (run.code, run.err) == (0, "")
    pairs, rows = _pairs(run.out), _rows(run.out)
    assert pairs["maps"] == "12 of 12 images, the first 120 x 90, kind z"
    assert pairs["left out"] == "0"
    scene = load_scene(room)
    expected = align(scene.replace(depths=find_depths(scene, room / "depths")))
    assert rows.keys() == expected.keys()
    for name, (points, scale, _, residual) in rows.items():
        assert int(points.replace(",", "")) == expected[name].num_points
        assert float(scale) == pytest.approx(expected[name].scale, rel=1e-3)
        assert float(scale) == pytest.approx(1, abs=0.02)
        assert float(residual.rstrip("%")) == pytest.approx(100 * expected[name].residual, abs=0.01)
    assert f"--method depth --depth {room / 'depths'}" in run.out.splitlines()[-1]


def test_the_worst_are_listed_first_and_the_rest_on_demand(tour, tmp_path, splatseed):
    def spoil(i, z):
        return np.where(np.random.default_rng(i).random(z.shape) < 0.4, z * 1.3, z) if i == 4 else z

    maps = _rewrite(tour, tmp_path / "maps", spoil)
    short = splatseed("info", tour, "--depth", maps).out
    assert "the 12 worst; --json has all" in short
    assert len(_rows(short)) == 12
    assert next(iter(_rows(short))) == sorted(find_depths(load_scene(tour), maps))[4]
    assert len(json.loads(splatseed("info", tour, "--depth", maps, "--json").out)["depth"]) == 15


def test_why_an_image_is_left_out(tour, tmp_path, splatseed):
    names = sorted(image.name for image in load_scene(tour).images)[:8]
    blind = lambda i, z: z * np.nan if i == 2 else z
    maps = _rewrite(tour, tmp_path / "maps", blind, names=names)
    out = splatseed("info", tour, "--depth", maps).out
    pairs = _pairs(out)
    assert pairs["maps"].startswith("8 of 15 images")
    assert pairs["left out"] == "1"
    assert f"- {names[2]}: the map has no depth at any pixel" in out
    assert "- 1 of 8 depth maps cannot be aligned with the points" in out.partition("problems")[2]
    assert "no problems" not in out
    assert _rows(out)[names[2]] == ("0", "-", "", "-")
    assert next(iter(_rows(out))) == names[2]


def test_as_many_points_are_asked_for_as_depth_prints(tour, tmp_path, splatseed):
    few = lambda i, z: np.where(np.arange(z.size).reshape(z.shape) < 200 * (i + 1), z, np.nan)
    maps = _rewrite(tour, tmp_path / "maps", few)
    known = 200 * sum(range(1, 16))  # the first map says nothing about the others
    number = number_for(len(load_scene(tour).points), known, 10**6)
    assert number.startswith("--num-points")
    assert splatseed("info", tour, "--depth", maps).out.splitlines()[-1].count(f" {number} ") == 1


@pytest.mark.parametrize(
    ("points", "known", "most", "said"),
    [
        (100, 10**6, 10**6, "--ratio 16"),
        (100, 10**6, 900, "--num-points 900"),  # training would thin out the others
        (100, 80, 900, "--num-points 110"),
        (100, 10**6, 50, "--num-points 101"),
        (0, 800, 10**6, "--num-points 100"),
    ],
)
def test_no_more_points_are_asked_for_than_there_is_room_for(points, known, most, said):
    assert number_for(points, known, most) == said


def test_a_scenes_own_maps_are_counted(tmp_path, splatseed):
    capture = make_capture(0, num_views=3, width=96, height=72)
    folder = tmp_path / "capture"
    write_capture(capture, tmp_path / "room")
    _as_rgbd(load_scene(tmp_path / "room"), tmp_path / "room" / "depths", folder)
    assert _pairs(splatseed("info", folder).out)["depth maps"] == "3"
    run = splatseed("info", folder, "--depth", folder)
    assert run.code == 0
    assert "no points to align the depth maps with" in run.out
    assert "left out" not in run.out
    lifted, triangulated = run.out.splitlines()[-2:]
    assert "splatseed sfm" in triangulated
    words = shlex.split(lifted.split("splatseed ")[1])
    made = splatseed(*[tmp_path / "out" if word == "OUT" else word for word in words])
    assert made.code == 0, made.err
    wanted = int(words[words.index("--num-points") + 1])
    assert len(load_scene(tmp_path / "out").points) == wanted > 100


def _as_rgbd(scene, depths, folder):
    """The scene in NICE-SLAM's layout."""
    (folder / "results").mkdir(parents=True)
    poses = []
    for i, image in enumerate(sorted(scene.images, key=lambda each: each.name)):
        with PilImage.open(scene.source.image_dir / image.name) as picture:
            picture.save(folder / "results" / f"frame{i:06}.jpg")
        values = find_depths(scene, depths).read(image.name).values
        stored = np.uint16(np.nan_to_num(values) * 1000)
        PilImage.fromarray(stored).save(folder / "results" / f"depth{i:06}.png")
        poses.append(" ".join(map(str, image.camera.world_from_cam.ravel())))
    (folder / "traj.txt").write_text("\n".join(poses) + "\n")
    K = image.camera.K
    names = {"w": 96, "h": 72, "fx": K[0, 0], "fy": K[1, 1], "cx": 47.5, "cy": 35.5, "scale": 1000}
    (folder / "cam_params.json").write_text(json.dumps({"camera": names}))


def test_the_picture_shows_photographs_depth_and_points(tour, tmp_path, splatseed):
    blind = lambda i, z: z * np.nan if i == 2 else z
    maps = _rewrite(tour, tmp_path / "maps", blind)
    words = ("info", tour, "--depth", maps, "--picture")
    assert splatseed(*words, tmp_path / "a.png").code == 0
    assert splatseed(*words, tmp_path / "b.png").code == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    page = np.asarray(PilImage.open(tmp_path / "a.png"))
    assert page.shape == (4 * (360 + 34) + 12 + 44, 3 * (480 + 12) + 12, 3)
    tiles = [
        [page[34 + r * 394 : 394 + r * 394, 12 + c * 492 : 492 + c * 492] for c in range(3)]
        for r in range(4)
    ]
    for photograph, depth, points in tiles[:3]:
        assert len(np.unique(photograph.reshape(-1, 3), axis=0)) > 500
        assert not (depth == (150, 150, 150)).all(axis=2).all()
        paled = np.abs(np.ptp(points.astype(int), axis=2)) == 0
        assert 0.5 < paled.mean() < 0.999  # grey but for the points
    blind_depth, blind_points = tiles[3][1:]
    assert (blind_depth == (150, 150, 150)).all()
    assert (np.ptp(blind_points.astype(int), axis=2) == 0).all()


def test_near_is_yellow_and_a_hole_is_grey(room, tmp_path, splatseed):
    def ramp(_, z):
        made = np.tile(np.linspace(1, 9, z.shape[1]), (len(z), 1))
        made[:, : z.shape[1] // 4] = np.nan
        return made

    maps = _rewrite(room, tmp_path / "maps", ramp)
    assert splatseed("info", room, "--depth", maps, "--picture", tmp_path / "a.png").code == 0
    tile = np.asarray(PilImage.open(tmp_path / "a.png"))[34:394, 504:984].astype(int)
    assert (tile[100, :118] == 150).all()
    near, far = tile[100, 130], tile[100, -5]
    assert near[0] > near[2]  # yellow: more red than blue
    assert far[2] > far[0]  # violet


def test_a_damaged_map_is_named_and_no_picture_left(own_room, tmp_path, splatseed):
    path = max((own_room / "depths").glob("*.png"))
    path.write_bytes(path.read_bytes()[:40])
    words = ("--depth", own_room / "depths", "--picture", tmp_path / "a.png")
    run = splatseed("info", own_room, *words)
    assert run.code == 2
    assert path.name in run.err
    assert not (tmp_path / "a.png").exists()
