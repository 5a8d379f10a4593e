"""Which code a run belongs to: what changes a version, and that runs of several are kept apart."""

from __future__ import annotations

import dataclasses
import sys

import pytest

pytest.importorskip("pandas", reason="studies need pandas")

from splatseed.bench import versions
from splatseed.bench.runs import changed_code
from splatseed.bench.study import studies
from splatseed.bench.study_tables import arm_table
from splatseed.bench.versions import method_version
from splatseed.methods import METHODS

from .planted import SCENES, runs, write_bench

METHOD = """\
from dataclasses import dataclass

import numpy
from {base} import Base


@dataclass(frozen=True)
class Jitter(Base):
    radius: float = 0.5

    def __call__(self, scene, num_new, rng, progress):
        from late import SHIFT
        ...


def plain(scene, num_new, rng, progress):
    ...
"""


@pytest.fixture(autouse=True)
def _own_path(monkeypatch):
    """Files that are imported as methods put their folder on the path."""
    monkeypatch.setattr(sys, "path", [*sys.path])


@pytest.fixture
def files(tmp_path):
    """A method in a file, whose base class and constant are in files beside it."""
    folder = tmp_path / "own"
    folder.mkdir()
    (folder / "my_jitter.py").write_text(METHOD.format(base="my_base"))
    (folder / "my_base.py").write_text("class Base:\n    pass\n")
    (folder / "late.py").write_text("SHIFT = 1\n")
    (folder / "other.py").write_text("import numpy\n")
    yield folder
    sys.modules.pop("my_base", None)


@pytest.mark.parametrize("name", ["Jitter", "plain"])
def test_a_method_in_a_file_has_the_version_of_all_files_that_it_imports(files, name):
    place = f"{files / 'my_jitter.py'}:{name}"
    assert callable(METHODS[place])
    seen = {method_version(place)}
    for file in ("my_jitter.py", "my_base.py", "late.py"):
        path = files / file
        path.write_text(path.read_text() + "# changed\n")
        seen.add(method_version(place))
    assert len(seen) == 4
    before = method_version(place)
    (files / "other.py").write_text("import numpy as np\n")
    assert method_version(place) == before
    assert method_version("mls") == ""


def test_a_version_is_that_of_the_content_wherever_it_lies(files, tmp_path):
    place = f"{files / 'my_jitter.py'}:plain"
    before = method_version(place)
    files.rename(tmp_path / "elsewhere")
    assert method_version(f"{tmp_path / 'elsewhere' / 'my_jitter.py'}:plain") == before


def test_an_installed_package_has_its_version_and_those_of_all_its_files(tmp_path, monkeypatch):
    site = tmp_path / "site-packages"
    package, info = site / "my_package", site / "my_package-1.2.dist-info"
    for folder in (package, info):
        folder.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "inner.py").write_text("from . import table\nimport my_second\n"
                                      "def make(scene, num_new, rng, progress): ...\n")  # fmt: skip
    (package / "table.py").write_text("")
    (package / "table.npy").write_bytes(b"1")
    (site / "my_second.py").write_text("import my_library\n")
    (site / "my_library.py").write_text("")
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.2\n")
    (info / "RECORD").write_text("my_package/inner.py,,\nmy_second.py,,\n")
    (info / "entry_points.txt").write_text("[splatseed.methods]\nmine = my_package.inner:make\n")
    sys.path.insert(0, str(site))
    monkeypatch.delitem(METHODS.__dict__, "_plugins", raising=False)
    try:
        seen = [method_version("mine")]
        assert seen[0].startswith("1.2+")
        (package / "cache").mkdir()
        (package / "cache" / "splatseed.json").write_text("{}")  # a benchmark's, for instance
        (site / "my_library.py").write_text("# another distribution's")
        assert method_version("mine") == seen[0]
        for file in (package / "table.py", package / "table.npy", site / "my_second.py"):
            file.write_bytes(b"# 2")
            seen.append(method_version("mine"))
        info.rename(site / "my_package-1.3.dist-info")
        info = site / "my_package-1.3.dist-info"
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.3\n")
        METHODS.__dict__.pop("_plugins", None)
        seen.append(method_version("mine"))
        assert len(set(seen)) == 5
        assert seen[-1] == seen[-2].replace("1.2", "1.3")
    finally:
        METHODS.__dict__.pop("_plugins", None)


def test_the_version_of_splatseed_covers_its_files(tmp_path, monkeypatch):
    (tmp_path / "bench").mkdir()
    monkeypatch.setattr(versions, "__file__", str(tmp_path / "bench" / "versions.py"))
    seen = set()
    for content in ("a = 1", "a = 2"):
        (tmp_path / "__init__.py").write_text(content)
        seen.add(versions.splatseed_version.__wrapped__())
    assert len(seen) == 2


def _of_code(planned, code, **changes):
    own = [code * (run.spec.arm.method != "sfm") for run in planned]
    return [
        dataclasses.replace(r, spec=dataclasses.replace(r.spec, method_version=v, **changes))
        for r, v in zip(planned, own, strict=True)
    ]


def test_results_of_changed_code_are_kept_apart_and_named(tmp_path):
    gains = {("sfm", 1): 0.0, ("mine.py:make", 8): 0.5}
    worse = {("sfm", 1): 0.0, ("mine.py:make", 8): -3.0}
    old = _of_code(runs(gains=gains, noise=0.0), "1.0+aaaaaaaaaaaa")
    new = _of_code(runs(gains=worse, noise=0.0), "1.1+bbbbbbbbbbbb")
    assert {a.spec.key == b.spec.key for a, b in zip(old, new, strict=True)
            if a.spec.arm.method != "sfm"} == {False}  # fmt: skip
    bench = write_bench(tmp_path / "B", old)
    (note,) = changed_code(bench, [run.spec for run in new])
    assert note.text == (
        f"The code has changed ({3 * len(SCENES)} runs to repeat): method mine.py:make is "
        "1.1+bbbbbbbbbbbb, was 1.0+aaaaaaaaaaaa. The earlier results are kept apart."
    )
    assert list(changed_code(bench, [run.spec for run in old])) == []
    (study,) = studies([*new, *old])
    gained = {row[0]: row[3] for row in arm_table(study).rows}
    assert {label: getattr(cell, "value", cell) for label, cell in gained.items()} == {
        "mine.py:make 8x code=1.0+aaaaaa": pytest.approx(0.5),
        "mine.py:make 8x code=1.1+bbbbbb": pytest.approx(-3.0),
        "sfm": "baseline",
    }
    assert "mine.py:make 1.1+bbbbbbbbbbbb" in study.description
    changed = _of_code(old, "1.0+aaaaaaaaaaaa", version="0.2.0")
    (note,) = changed_code(bench, [run.spec for run in changed])
    assert "(24 runs to repeat): splatseed is 0.2.0, was 0.1.0." in note.text
    assert len(studies([*old, *changed])) == 2


def test_a_benchmark_from_before_versions_of_methods_is_read_by_its_keys():
    (run, *_) = runs()
    assert "method_version" not in run.spec.to_dict()
    assert run.spec.key == dataclasses.replace(run.spec, method_version="").key
