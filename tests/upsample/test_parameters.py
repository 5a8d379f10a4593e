"""How many points, by which method, with which parameters: and what is said when it cannot be."""

from __future__ import annotations

import numpy as np
import pytest

import splatseed as ss
from splatseed import METHODS
from splatseed.errors import ParameterError, PointCloudError
from splatseed.upsample import configure
from splatseed.upsample.method import NewPoints

from .contract import METHOD_NAMES, PHOTOGRAPH_METHODS, Copies

BUILT_IN = [name for name in METHOD_NAMES if name != "copies"]

WRONG_PARAMETERS = [
    ("mls", {"k": 2}, "mls.k of at least 3"),
    ("mls", {"k": 10.0}, "mls.k as a whole number"),
    ("mls", {"k": "10"}, "mls.k as a whole number"),
    ("mls", {"k": True}, "mls.k as a whole number"),
    ("mls", {"frame": "locl"}, "'local' or 'world'"),
    ("mls", {"placement": "disk"}, "'disc' or 'triangle' or 'box'"),
    ("mls", {"disc_radius": 0}, "disc_radius above 0"),
    ("mls", {"disc_radius": np.inf}, "a finite number"),
    ("mls", {"clamp": -0.1}, "clamp of at least 0"),
    ("mls", {"clamp": np.nan}, "a finite number or none"),
    ("mls", {"neighbours": 12}, "a parameter of mls"),
    ("linear", {"k": 3}, "a parameter of linear"),
    ("linear", {"reject_isolated": 1}, "true or false"),
    ("random", {"k": 3}, "it has none"),
    ("spline", {"smoothing": 0}, "smoothing above 0"),
    ("spline", {"smoothing": "gvc"}, "'gcv'"),
    ("spline", {"basis": "cubic"}, "'pspline' or 'bicubic'"),
    ("voronoi", {"k": 3}, "voronoi.k from 4"),
    ("voronoi", {"k": 1000}, "voronoi.k from 4"),
    ("voronoi", {"ball": 0}, "ball above 0"),
    ("voronoi", {"color_k": 26}, "color_k from 1"),
    ("voronoi", {"max_weight": 0.5}, "max_weight of at least 1"),
    ("voronoi", {"cells": "boxes"}, "'clamped' or 'box'"),
    ("depth", {"fit": "ransac"}, "'robust' or 'least-squares'"),
    ("depth", {"min_points": 0}, "min_points of at least 1"),
    ("depth", {"max_residual_ratio": 0.5}, "max_residual_ratio of at least 1"),
    ("depth", {"region": 0}, "region above 0"),
    ("depth", {"region": 1.5}, "region above 0"),
    ("depth", {"placement": "far"}, "'empty' or 'uniform'"),
    ("depth", {"edge_tolerance": 0}, "edge_tolerance above 0"),
    ("depth", {"edge_radius": 0}, "edge_radius from 1"),
    ("depth", {"num_neighbors": 0}, "num_neighbors from 1"),
    ("depth", {"min_agreeing": 13}, "min_agreeing from 0 to 12"),
    ("depth", {"tolerance": 1}, "tolerance between 0 and 1"),
    ("depth", {"color_tolerance": 2}, "color_tolerance above 0"),
    ("depth", {"hold_out": 1}, "hold_out of 0 or 2"),
]


@pytest.mark.parametrize(("method", "wrong", "says"), WRONG_PARAMETERS, ids=str)
def test_wrong_parameters_are_named(method, wrong, says):
    with pytest.raises(ParameterError, match=says):
        configure(method, **wrong)


WRONG_CALLS = [
    ({"method": "mlx"}, "linear, triangle"),
    ({"profile": "papr"}, "'default' or 'paper'"),
    ({"ratio": 0.5}, "at least 1"),
    ({"ratio": np.nan}, "at least 1"),
    ({"ratio": np.inf}, "at least 1"),
    ({"ratio": 1e308}, "4,294,967,296 at most"),
    ({"num_points": 159}, "at least the 160 originals"),
    ({"num_points": -1}, "at least the 160 originals"),
    ({"num_points": 200.5}, "a whole number"),
    ({"ratio": 2, "num_points": 320}, "found both"),
    ({"seed": -1}, "a seed"),
    ({"seed": "one"}, "a seed"),
    ({"ratio": "8"}, "expected ratio of at least 1"),
    ({"num_points": "800"}, "a whole number of points"),
]


@pytest.mark.parametrize(("options", "says"), WRONG_CALLS, ids=str)
def test_wrong_calls_are_named(options, says, wavy):
    with pytest.raises(ParameterError, match=says):
        ss.upsample(wavy, **options)


@pytest.mark.parametrize("extra", [{"k": 9}, {"profile": "paper"}], ids=str)
def test_a_configured_method_takes_nothing_more(extra, wavy):
    with pytest.raises(ParameterError, match="its own parameters"):
        ss.upsample(wavy, configure("mls"), **extra)


@pytest.mark.parametrize("method", BUILT_IN)
@pytest.mark.parametrize("size", [{"ratio": 1}, {"num_points": 160}], ids=str)
def test_nothing_to_add_gives_the_originals(method, size, wavy):
    seeds = ss.upsample(wavy, method, **size)
    np.testing.assert_array_equal(seeds.xyz, wavy.xyz)
    np.testing.assert_array_equal(seeds.rgb, wavy.rgb)


PAPER_VALUES = [
    ("mls", {"k": 10}),
    ("spline", {"k": 25, "basis": "bicubic"}),
    ("voronoi", {"ball": 0.5, "color_k": 5}),
    *((m, {"frame": "world", "placement": "box", "clamp": None}) for m in ("mls", "spline")),
    *((m, {"reject_isolated": False}) for m in BUILT_IN if m not in {"depth", "random"}),
    ("depth", {"fit": "least-squares", "unit_ray": True, "region": 0.5, "placement": "uniform"}),
    ("depth", {"min_agreeing": 0, "see_through": True, "spread": False, "edge_tolerance": None}),
]


@pytest.mark.parametrize(("method", "values"), PAPER_VALUES, ids=str)
def test_the_paper_profile_has_the_papers_values(method, values):
    chosen = configure(method, "paper")
    assert {name: getattr(chosen, name) for name in values} == values


@pytest.mark.usefixtures("third_party")
def test_a_third_party_adds_methods_and_takes_none_over(wavy):
    assert METHODS["copies"] is Copies
    assert METHODS["mls"] is not Copies
    names = [*BUILT_IN, *PHOTOGRAPH_METHODS, "cloud", "copies"]
    assert list(METHODS) == names
    assert len(METHODS) == len(names)
    assert set(ss.upsample(wavy, "copies").source) == {0, 255}


def test_a_third_partys_bad_points_are_refused(wavy):
    class Broken(Copies):
        def __call__(self, cloud, num_new, rng, progress):
            new = super().__call__(cloud, num_new, rng, progress)
            new.xyz[17, 1] = np.nan
            return NewPoints(*new)

    with pytest.raises(PointCloudError, match="at new point 17"):
        ss.upsample(wavy, Broken())


class Knowing(Copies):
    """A third party's method that knows more of its points."""

    def __call__(self, cloud, num_new, rng, progress):
        new = super().__call__(cloud, num_new, rng, progress)
        source = np.where(np.arange(num_new) % 2, 8, 9).astype(np.uint8)
        return new._replace(sizes=np.full(num_new, 0.5), source=source)


def test_what_a_method_knows_of_its_points_is_handed_on(wavy):
    seeds = ss.upsample(wavy, Knowing(), num_points=len(wavy) + 4)
    assert seeds.source[len(wavy) :].tolist() == [9, 8, 9, 8]
    assert seeds.sizes[len(wavy) :].tolist() == [0.5] * 4
    assert np.isnan(seeds.sizes[: len(wavy)]).all()
    assert seeds.normals is None
    assert ss.upsample(wavy, Copies(), num_points=len(wavy) + 4).attributes == {}


@pytest.mark.parametrize("source", [np.zeros(4, np.uint8), np.full(4, 256), np.full(4, 8.0)])
def test_new_points_are_no_originals(wavy, source):
    class Posing(Copies):
        def __call__(self, cloud, num_new, rng, progress):
            return super().__call__(cloud, num_new, rng, progress)._replace(source=source)

    with pytest.raises(PointCloudError, match="codes from 1 to 255"):
        ss.upsample(wavy, Posing(), num_points=len(wavy) + 4)
