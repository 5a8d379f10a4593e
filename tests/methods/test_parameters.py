"""How many points, by which method, with which parameters: and what is said when it cannot be."""

from __future__ import annotations

import dataclasses
import inspect
import sys
from importlib.metadata import EntryPoint

import numpy as np
import pytest

import splatseed as ss
from splatseed import METHODS
from splatseed.errors import (
    MissingDependencyError,
    ParameterError,
    PluginError,
    PointCloudError,
    UnknownNameError,
)
from splatseed.findings import Finding
from splatseed.methods import configure
from splatseed.pointcloud import PointCloud

from .contract import METHOD_NAMES, PHOTOGRAPH_METHODS, Copies

BUILT_IN = [name for name in METHOD_NAMES if name != "copies"]
PAPER = {"profile": "paper"}

WRONG_PARAMETERS = {
    "mls.k": (2, 10.0, "10", True),
    "mls.frame": ("locl",),
    "mls.disc_radius": (0, np.inf),
    "mls.clamp": (-0.1, np.nan),
    "mls.neighbours": (12,),
    "linear.k": (3,),
    "linear.reject_isolated": (1,),
    "random.k": (3,),
    "spline.smoothing": (0, "gvc"),
    "spline.basis": ("cubic",),
    "voronoi.k": (3, 1000),
    "voronoi.ball": (0,),
    "voronoi.color_k": (26,),
    "voronoi.max_weight": (0.5,),
    "depth.fit": ("ransac",),
    "depth.min_points": (0,),
    "depth.max_residual_ratio": (0.5,),
    "depth.central_fraction": (0, 1.5),
    "depth.edge_tolerance": (0,),
    "depth.edge_radius": (0,),
    "depth.num_neighbors": (0,),
    "depth.min_agreeing": (13,),
    "depth.tolerance": (1,),
    "depth.color_tolerance": (2,),
    "depth.test_every": (1, -1),
}


@pytest.mark.parametrize("parameter", WRONG_PARAMETERS)
def test_wrong_parameters_are_named(parameter):
    method, name = parameter.split(".")
    for wrong in WRONG_PARAMETERS[parameter]:
        with pytest.raises(ParameterError, match=f"{parameter}|a parameter of {method}.*{name}"):
            configure(method, **{name: wrong})


WRONG_CALLS = [
    ({"method": "mlx"}, "linear, triangle"),
    ({"profile": "papr"}, "'default' or 'paper'"),
    *(({"ratio": wrong}, "at least 1") for wrong in (0.5, np.nan, np.inf, "8")),
    ({"ratio": 1e308}, "4,294,967,296 at most"),
    *(({"num_points": wrong}, "at least the 160 originals") for wrong in (159, -1)),
    *(({"num_points": wrong}, "a whole number") for wrong in (200.5, "800")),
    ({"ratio": 2, "num_points": 320}, "found both"),
    ({"method": "depth", "region": 0.5}, r"`region` as text.*found 0\.5.*central_fraction"),
    ({"region": (0, 0, 0, 1, 1, 1)}, r"'x0,y0,z0,x1,y1,z1' for a box.*found \(0, 0, 0"),
    *(({"seed": wrong}, "a seed") for wrong in (-1, "one")),
    *(({"method": Copies(), **own}, "no parameters next to") for own in ({"k": 9}, PAPER)),
]


@pytest.mark.parametrize(("options", "says"), WRONG_CALLS, ids=str)
def test_wrong_calls_are_named(options, says, wavy):
    with pytest.raises(ParameterError, match=says):
        ss.upsample(wavy, **options)


def test_no_parameter_of_a_method_has_the_name_of_an_argument_of_upsample():
    arguments = set(inspect.signature(ss.upsample).parameters)
    for name in [*BUILT_IN, *PHOTOGRAPH_METHODS, "cloud"]:
        assert not arguments & {field.name for field in dataclasses.fields(METHODS[name])}


@pytest.mark.parametrize("method", BUILT_IN)
@pytest.mark.parametrize("size", [{"ratio": 1}, {"num_points": 160}], ids=str)
def test_nothing_to_add_gives_the_originals(method, size, wavy):
    seeds = ss.upsample(wavy, method, **size)
    np.testing.assert_array_equal(seeds.xyz, wavy.xyz)
    np.testing.assert_array_equal(seeds.rgb, wavy.rgb)


PAPER_DEPTH = {
    "fit": "least-squares", "unit_ray": True, "central_fraction": 0.5, "placement": "uniform",
    "min_agreeing": 0, "see_through": True, "spread": False, "edge_tolerance": None,
}  # fmt: skip


def test_depth_has_the_papers_values():
    """Those of the other methods are in the references'."""
    chosen = configure("depth", "paper")
    assert {name: getattr(chosen, name) for name in PAPER_DEPTH} == PAPER_DEPTH


@pytest.mark.usefixtures("third_party")
def test_a_third_party_adds_methods_and_takes_none_over(wavy):
    assert METHODS["copies"] is Copies
    assert METHODS["mls"] is not Copies
    names = [*BUILT_IN, *PHOTOGRAPH_METHODS, "cloud", "copies"]
    assert list(METHODS) == names
    assert len(METHODS) == len(names)
    assert set(ss.upsample(wavy, "copies").source) == {0, 255}


def test_a_method_that_is_not_installed_or_broken_is_explained(monkeypatch):
    with pytest.raises(UnknownNameError, match=r"'copies'.*registers.*pip inst"):
        METHODS["copies"]
    entry = EntryPoint("copies", "no_such_module:Copies", "splatseed.methods")
    monkeypatch.setitem(METHODS._plugins, "copies", entry)
    expected = r"'copies', no_such_module:Copies .*ModuleNotFoundError.*pip uninstall"
    with pytest.raises(MissingDependencyError, match=expected):
        ss.upsample(ss.PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.uint8)), "copies")


def test_a_method_is_known_by_its_place_in_a_file(wavy, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "helper.py").write_text("SHIFT = 1.0")
    file = tmp_path / "mls.py"
    code = """
from __future__ import annotations
from dataclasses import dataclass
from helper import SHIFT

@dataclass(frozen=True)
class Shifted:
    by: float = {by}

    def __call__(self, scene, num_new, rng, progress):
        return scene.points.xyz[:num_new] + self.by * SHIFT, scene.points.rgb[:num_new]

mls = Shifted(2.0)

def stereo(scene, num_new, rng, progress):
    return Shifted(3.0)(scene, num_new, rng, progress)
"""
    file.write_text(code.format(by=1.0))
    for name, parameters, by in (
        ("Shifted", {}, 1), ("Shifted", {"by": 4.0}, 4), ("mls", {}, 2), ("stereo", {}, 3)
    ):  # fmt: skip
        seeds = ss.upsample(wavy, f"{file}:{name}", num_points=170, **parameters)
        np.testing.assert_allclose(seeds.xyz[160:], wavy.xyz[:10] + by, rtol=1e-6)
        assert set(seeds.source[160:]) == {255}
    given = ss.upsample(wavy, METHODS[f"{file}:stereo"](), num_points=170)
    assert set(given.source[160:]) == {255}
    file.write_text(code.format(by=5.0))  # as in a notebook, between two calls
    seeds = ss.upsample(wavy, f"{file}:Shifted", num_points=170)
    np.testing.assert_allclose(seeds.xyz[160:], wavy.xyz[:10] + 5, rtol=1e-6)
    with pytest.raises(ParameterError, match=r"a parameter of .*it has none"):
        ss.upsample(wavy, f"{file}:stereo", k=3)
    for name, found in (("mls.py:none", "no attribute"), ("none.py:mls", "FileNotFound"),
                        ("mls.py:SHIFT", "cannot be called")):  # fmt: skip
        with pytest.raises(MissingDependencyError, match=found):
            METHODS[f"{tmp_path / name}"]


class Changing(Copies):
    """A third party's method that knows more of its points, or gets them wrong."""

    def __init__(self, change):
        object.__setattr__(self, "change", change)

    def __call__(self, scene, num_new, rng, progress):
        return self.change(PointCloud(*super().__call__(scene, num_new, rng, progress)))


def test_what_a_method_knows_of_its_points_is_handed_on(wavy):
    source, sizes = np.array([9, 8, 9, 8], np.uint8), np.full(4, 0.5)
    knowing = Changing(lambda new: new.replace(sizes=sizes, source=source))
    seeds = ss.upsample(wavy, knowing, num_points=len(wavy) + 4)
    assert seeds.source[len(wavy) :].tolist() == [9, 8, 9, 8]
    assert seeds.sizes[len(wavy) :].tolist() == [0.5] * 4
    assert np.isnan(seeds.sizes[: len(wavy)]).all()
    assert seeds.normals is None
    assert ss.upsample(wavy, Copies(), num_points=len(wavy) + 4).attributes == {}


class Reporting(Copies):
    """A third party's method that reports what it was called with."""

    def __call__(self, scene, num_new, rng, progress, *, note, budget):
        note(Finding("copies", f"{num_new} of {budget}"))
        return super().__call__(scene, num_new, rng, progress)


def test_a_method_may_report_findings_and_know_the_budget(wavy):
    notes, num = [], len(wavy) + 4
    ss.upsample(wavy, Reporting(), num_points=num, budget=num + 1, note=notes.append)
    assert notes == [Finding("copies", f"4 of {num + 1}")]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda new: new.replace(xyz=np.full((4, 3), np.nan)), "at new point 0"),
        (lambda new: new.select(slice(3)), r"4 new points.*'Changing'; found a PointCloud of 3\."),
        (lambda new: new.with_added(np.zeros((160, 3)), np.zeros((160, 3), np.uint8)),
         r"found a PointCloud of 164\. Return the new points only"),
        (lambda _: None, r"'Changing'; found None\."),
        (lambda new: new.xyz, r"found float32 \[4, 3\]\."),
        (lambda new: (new.xyz, new.rgb / 255), r"float32 \[4, 3\], float64 \[4, 3\]\. Correct"),
        (lambda new: (new.xyz[:3], new.rgb), r"tuple of float32 \[3, 3\], uint8 \[4, 3\]\."),
        (lambda new: new.replace(xyz=new.xyz[:3], rgb=new.rgb[:3]),
         r"of shape \[3\], in method 'Changing', line \d+ of .*test_parameters\.py; found \[4\]"),
        (lambda new: new.missing, r"'Changing' without an exception; found Attribute.*line \d+"),
    ],
)  # fmt: skip
def test_a_third_partys_bad_points_are_refused(change, says, wavy):
    with pytest.raises((PointCloudError, PluginError), match=says):
        ss.upsample(wavy, Changing(change), num_points=len(wavy) + 4)
