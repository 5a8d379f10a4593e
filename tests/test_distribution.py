"""The wheel and the source package hold all that they should."""

from __future__ import annotations

import importlib
import os
import tarfile
import tomllib
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "src" / "splatseed"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
PACKAGE = {
    path.relative_to(SOURCE.parent).as_posix()
    for path in SOURCE.rglob("*")
    if path.is_file() and "__pycache__" not in path.parts
}
NEEDED = {  # that no import would miss
    "splatseed/__init__.pyi", "splatseed/py.typed", "splatseed/bench/data/report.html",
    "splatseed/viewer/supersplat/LICENSE", "splatseed/viewer/supersplat/index.js.gz",
}  # fmt: skip


def test_no_file_of_the_package_is_left_out_by_its_settings():
    """Hatchling takes the folder, without what .gitignore names."""
    assert PACKAGE > NEEDED
    targets = PROJECT["tool"]["hatch"]["build"]["targets"]
    assert targets["wheel"] == {"packages": ["src/splatseed"]}
    ignored = (ROOT / ".gitignore").read_text("utf-8").split()
    names = {part for path in PACKAGE for part in Path(path).parts}
    assert not names & {name.strip("/") for name in ignored if not name.startswith("/")}
    for name in (*targets["sdist"]["include"], *PROJECT["project"]["license-files"]):
        assert (ROOT / name).exists(), name


@pytest.mark.skipif(find_spec("hatchling") is None, reason="building needs hatchling")
def test_built_packages_hold_code_data_and_licences(tmp_path, monkeypatch):
    monkeypatch.chdir(ROOT)
    backend = importlib.import_module("hatchling.build")
    with zipfile.ZipFile(tmp_path / backend.build_wheel(os.fspath(tmp_path))) as wheel:
        files = set(wheel.namelist())
    info = f"splatseed-{PROJECT['project']['version']}.dist-info"
    assert files >= PACKAGE
    licences = {f"{info}/licenses/{name}" for name in PROJECT["project"]["license-files"]}
    assert files - PACKAGE >= {f"{info}/entry_points.txt", *licences}
    assert {file.partition("/")[0] for file in files} == {"splatseed", info}
    with tarfile.open(tmp_path / backend.build_sdist(os.fspath(tmp_path))) as archive:
        files = {name.partition("/")[2] for name in archive.getnames()}
    assert files >= {f"src/{name}" for name in PACKAGE}
    wanted = {"tests/conftest.py", "docs/README.md", "examples/colab.ipynb", "Dockerfile"}
    assert files >= {*wanted, *PROJECT["project"]["license-files"], "mkdocs.yml", "Makefile"}
