"""The package as a whole: what imports what, what is public, and that it all says so."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import subprocess
import sys
import tomllib
from functools import cache
from graphlib import TopologicalSorter
from importlib.metadata import version
from importlib.util import resolve_name
from pathlib import Path

import pytest

import splatseed
from splatseed.cli import VERBS
from splatseed.errors import MissingDependencyError
from splatseed.requirements import EXTRAS, install_command, require

ROOT = Path(__file__).parents[1]
SOURCE = Path(splatseed.__file__).parent

ORDER = (
    "errors", "text", "settings", "requirements", "findings", "progress", "frozen", "sampling",
    "projection", "runtime", "camera", "similarity", "lens", "pointcloud", "depthmap", "tracks",
    "scene", "scores", "io", "photos", "depth", "methods", "checkup", "sfm", "seeding", "synthetic",
    "rendering", "splat", "training", "integrations", "viewer", "bench", "console", "commands",
    "cli",
)  # fmt: skip
"""Parts of the package: each imports only parts before it, or itself."""

DELEGATING = {
    "pointcloud": {"splatseed.io.ply"},  # PointCloud.read_ply, write_ply
    "scene": {  # Image.read, size, lens, read_mask
        "splatseed.io.photograph",
        "splatseed.io.photograph_checks",
        "splatseed.io.masks",
    },
}
"""What methods of data types hand over to when they are called: io, which imports these types."""


@cache
def _tree(path):
    """A file's syntax, which several tests look through."""
    return ast.parse(path.read_text(encoding="utf-8"))


@cache
def _import_statements(path):
    """A file's imports, also those within functions."""
    return [n for n in ast.walk(_tree(path)) if isinstance(n, ast.Import | ast.ImportFrom)]


def _imports(path):
    """What a file imports anywhere, also within functions."""
    for node in _import_statements(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            if node.module == "splatseed":  # of which a name may be a part of it
                yield from (f"splatseed.{alias.name}" for alias in node.names)
            else:
                yield str(node.module)


def _files(part):
    """The files of a part of the package, which is a module or a folder."""
    return sorted((SOURCE / part).rglob("*.py")) or [SOURCE / f"{part}.py"]


def test_what_errors_tell_to_install_is_what_the_package_asks_for():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    extras = {
        extra: {each.partition(";")[0] for each in packages}
        for extra, packages in project["optional-dependencies"].items()
    }
    for extra, wanted in EXTRAS.items():
        assert set(wanted) == extras[extra]
    assert extras.keys() == {*EXTRAS, "dev"}


def test_what_to_install_is_for_this_python_and_for_the_whole_extra(monkeypatch, tmp_path):
    monkeypatch.setattr("splatseed.requirements.find_spec", lambda _: None)
    monkeypatch.setattr("sys.executable", "/my venv/python")
    tested = tmp_path / "what was tested.txt"
    monkeypatch.setattr("splatseed.requirements._TESTED", tested)
    start = r"'/my venv/python' -m pip install"
    with pytest.raises(MissingDependencyError, match="the package torch; found no torch") as caught:
        require("torch")
    wanted = (
        "'torch>=2.5' 'gsplat>=1.5.3,<1.6' 'torchmetrics>=1.4' 'flip-evaluator>=1.7' 'pandas>=2.2' "
        "'jinja2>=3.1'"
    )
    assert caught.value.fix == (
        f"Install it (extra train): {start} {wanted}. On a machine without a GPU, PyTorch's CPU "
        f"build suffices: {start} {wanted} "
        "--extra-index-url https://download.pytorch.org/whl/cpu."
    )
    tested.touch()
    upgraded = install_command("pycolmap", upgrade=True)
    assert upgraded == f"{start} --upgrade -c '{tested}' 'pycolmap>=4.0' 'imageio-ffmpeg>=0.6'"


def test_nothing_is_to_be_installed_that_is_not_published():
    """An index has no splatseed yet, so its extras can be had from its own folder only."""
    for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *SOURCE.rglob("*.py")):
        text = " ".join(path.read_text("utf-8").split())
        assert not re.search(r"pip install [\"']?splatseed", text), path
        if path.suffix == ".py":  # messages name this Python's own pip; docstrings need not
            assert not re.search(r"(?<!-m )(?<!``)pip install", text), path


def test_every_part_has_its_place():
    files = [*SOURCE.glob("*.py"), *(path.parent for path in SOURCE.glob("*/__init__.py"))]
    parts = {path.stem for path in files}
    assert {part for part in parts if not part.startswith("__")} == set(ORDER)


@pytest.mark.parametrize("part", ORDER)
def test_imports_run_one_way(part):
    allowed = set(ORDER[: ORDER.index(part) + 1])
    for path in _files(part):
        names = [n.split(".") for n in _imports(path) if n not in DELEGATING.get(part, ())]
        ours = {name[1] for name in names if name[0] == "splatseed" and len(name) > 1}
        assert ours <= allowed, path.name
        assert ["splatseed"] not in names, f"{path.name} imports the whole package"


@pytest.mark.parametrize("part", [part for part in ORDER if (SOURCE / part).is_dir()])
def test_modules_of_a_part_import_each_other_in_no_circle(part):
    """A module is a folder of the part, or a file that is in none."""
    modules = {}
    for path in _files(part):
        place = path.relative_to(SOURCE / part)
        if place.name != "__init__.py" or len(place.parts) > 1:  # it imports all modules
            names = [name.split(".") for name in _imports(path)]
            ours = {name[2] for name in names if name[:2] == ["splatseed", part] and len(name) > 2}
            module = place.parts[0].removesuffix(".py")
            modules[module] = modules.get(module, set()) | ours - {module}
    TopologicalSorter(modules).prepare()  # raises CycleError, which names the circle


@pytest.mark.parametrize("part", ["photos", "depth", "methods", "checkup", "seeding"])
def test_what_makes_seeds_needs_little(part):
    """Beside the standard library; networks may need more."""
    allowed = {"splatseed", "numpy", "jaxtyping", "numba", "scipy"}
    more = {
        "photos": {"PIL", "platformdirs"},
        "depth": {"PIL", "llvmlite", "lazy_loader"},
        "methods": {"filelock"},
    }
    allowed |= more.get(part, set())
    for path in _files(part):
        tops = {name.split(".")[0] for name in _imports(path)}
        if path.name != "monocular.py":
            assert tops <= {*allowed, *sys.stdlib_module_names}, path.name


def test_an_import_loads_nothing_heavy():
    code = "import sys, splatseed, splatseed.io; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True)
    heavy = {"torch", "numba", "scipy", "matplotlib", "pycolmap", "PIL", "rich", "tyro"}
    assert not heavy & set(run.stdout.split())


VERBS_HELP = """
import sys
from splatseed.cli import VERBS, main
for words in (["--help"], *([verb, "--help"] for verb in VERBS)):
    try:
        main(words)
    except SystemExit as stop:
        assert not stop.code, words
    assert not {"numba", "pycolmap", "torch"} & set(sys.modules), words
"""


def test_help_does_not_wait_for_what_computes():
    command = [sys.executable, "-c", VERBS_HELP]
    run = subprocess.run(command, capture_output=True, check=False, text=True)
    assert (run.returncode, run.stderr) == (0, "")
    assert all(f"splatseed {verb}" in run.stdout for verb in VERBS)


def test_files_import_each_other_in_no_circle():
    """Also within functions, for type checkers alone, and in lists of lazy names (.pyi)."""
    paths, imports = module_paths(), {}
    for name, path in paths.items():
        parts = path.relative_to(SOURCE).with_suffix("").parts
        found = _imported_files(path, name, paths) - DELEGATING.get(".".join(parts), set())
        stub = path.with_suffix(".pyi")
        imports[name] = found | (_imported_files(stub, name, paths) if stub.is_file() else set())
    TopologicalSorter(imports).prepare()  # raises CycleError, which names the circle


def _imported_files(path, name, modules):
    """The modules of ours that a file imports anywhere, but itself."""
    found = set()
    for node in _import_statements(path):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            source = resolve_name("." * node.level + (node.module or ""), name)
            found |= {source, *(f"{source}.{alias.name}" for alias in node.names)}
            if any(f"{source}.{alias.name}" in modules for alias in node.names):
                found.discard(source)  # the package of a module that is named
    return (found & modules.keys()) - {name}


OPTION = re.compile(r"(?<![\w-])--[a-z][\w.-]*")
COMMAND = re.compile(r"\b(splatseed [a-z]+|hf|ray|colmap) ")


@pytest.mark.parametrize(
    "part", [part for part in ORDER if part not in {"requirements", "commands", "cli", "console"}]
)
def test_messages_of_the_library_name_arguments_not_options(part):
    """But for whole commands: see splatseed.errors."""
    for path in _files(part):
        for line, text in _texts(_tree(path)):
            assert COMMAND.search(text) or not OPTION.search(text), f"{path.name}:{line}: {text}"


def _texts(node):
    """The lines and contents of all strings below a node but docstrings."""
    for each in ast.iter_child_nodes(node):
        if isinstance(each, ast.JoinedStr):
            parts = (str(getattr(part, "value", "")) for part in each.values)
            yield each.lineno, "".join(parts)
        elif isinstance(each, ast.Constant) and isinstance(each.value, str):
            yield each.lineno, each.value
        elif not (isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant)):
            yield from _texts(each)


def test_imports_close_no_circle():
    """So any module can be imported first: none ever meets another that is half loaded.

    A module that is being loaded waits for those it imports and for the packages they are in, but
    for the packages it is in itself, which Python has begun before: it may ask nothing of them.
    """
    waits = {}
    paths = module_paths()
    for name, path in paths.items():
        wanted = set(_imported_on_loading(path, paths))
        assert not wanted & _packages_above(name), f"{name} imports a package that it is in"
        wanted |= {package for each in wanted for package in _packages_above(each)}
        waits[name] = wanted - _packages_above(name) - {name}
    TopologicalSorter(waits).prepare()  # raises CycleError, which names the circle


def module_paths():
    """Our modules' files by their names."""
    parts = {path: path.relative_to(SOURCE.parent).with_suffix("").parts for path in _files(".")}
    return {".".join(p[:-1] if p[-1] == "__init__" else p): path for path, p in parts.items()}


def _packages_above(name):
    parts = name.split(".")
    return {".".join(parts[:count]) for count in range(1, len(parts))}


def _imported_on_loading(path, modules):
    """Which of our modules a file imports when it is loaded itself, not when a function runs."""
    for node in _run_on_loading(_tree(path)):
        if isinstance(node, ast.Import):
            yield from {alias.name for alias in node.names} & modules.keys()
        elif isinstance(node, ast.ImportFrom) and node.module in modules:
            for alias in node.names:
                inner = f"{node.module}.{alias.name}"
                yield inner if inner in modules else node.module


def _run_on_loading(node):
    """All below a node but what is in functions or for type checkers alone."""
    for each in ast.iter_child_nodes(node):
        if isinstance(each, ast.If) and "TYPE_CHECKING" in ast.dump(each.test):
            continue
        if not isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield each
            yield from _run_on_loading(each)


def test_public_names_are_explained():
    """Only packages list names; in a module, what has no underscore is for others."""
    for name in module_paths():
        module = importlib.import_module(name)
        assert module.__doc__, name
        assert hasattr(module, "__path__") or "__all__" not in vars(module), name
        for each in getattr(module, "__all__", []):
            assert hasattr(module, each), f"{name}.{each}"
        for each in _own_public(module):
            _assert_explained(getattr(module, each), f"{name}.{each}")


def _own_public(module):
    """Public functions and classes that are defined in a module."""
    for name, each in vars(module).items():
        if not name.startswith("_") and getattr(each, "__module__", None) == module.__name__:
            yield name


def _assert_explained(each, where):
    """A docstring on a function, or on a class and all its public methods, inherited or own."""
    if not (inspect.isfunction(each) or inspect.isclass(each)):
        return
    assert each.__doc__, where
    for name, member in vars(each).items() if inspect.isclass(each) else ():
        function = member.fget if isinstance(member, property) else member
        function = getattr(function, "__func__", function)
        if inspect.isfunction(function) and not name.startswith("_"):
            assert inspect.getdoc(getattr(each, name)), f"{where}.{name}"


def test_the_front_door_lists_what_the_packages_promise():
    promised = "METHODS Camera PointCloud Scene SplatseedError add_cover load_scene stereo_depths"
    promised += " upsample write_scene Run evaluate train Gaussians read_gaussians render"
    promised += " __version__"
    assert sorted(splatseed.__all__) == sorted(promised.split())
    assert all(getattr(splatseed, name) for name in splatseed.__all__)


def test_every_error_is_ours_and_says_three_things():
    from splatseed import errors

    for name in _own_public(errors):
        error = getattr(errors, name)("a cat", found="a dog", fix="Look again.")
        assert isinstance(error, splatseed.SplatseedError)
        assert str(error) == "expected a cat; found a dog. Look again."
        assert (error.expected, error.found, error.fix) == ("a cat", "a dog", "Look again.")


def test_the_version_is_the_same_everywhere():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert version("splatseed") == project["version"]
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## \[?{re.escape(project['version'])}\b", changes, re.MULTILINE)


def test_dependencies_are_those_that_are_imported():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    base = {re.split(r"[><=\[;]", line)[0] for line in project["dependencies"]}
    names = {e: {re.split(r"[><=\[;]", line)[0] for line in extras[e]} for e in extras}
    more = names["train"] | names["tensorboard"]
    called = {"PIL": "pillow", "imageio_ffmpeg": "imageio-ffmpeg", "lazy_loader": "lazy-loader"}
    called["flip_evaluator"] = "flip-evaluator"
    for path in SOURCE.rglob("*.py"):
        imported = {name.split(".")[0] for name in _imports(path)}
        needed = imported - set(sys.stdlib_module_names) - {"splatseed", "pycolmap"}
        needed -= {"fused_ssim"} if path.name == "trainer.py" else set()  # taken where it is there
        part = path.relative_to(SOURCE).parts[0]
        trains = part in {"rendering", "splat", "training", "viewer", "bench", "commands"}
        # One loads torch, and gsplat's kernels, for those parts; one is a strategy of gsplat's.
        trains = trains or path.name in {"torch_device.py", "gsplat.py"}
        allowed = base | more if trains else base
        allowed = base | names["depth"] if path.name == "monocular.py" else allowed
        allowed = base | names["cluster"] if path.name.startswith("ray_") else allowed
        if part in {"splat", "viewer", "commands"} or path.name == "recordings.py":
            allowed = allowed | names["view"]
        if path.parent.name == "clouds":
            allowed = allowed | names["scan"]
        assert {called.get(name, name) for name in needed} <= allowed, path.name


def tracked_files(top, ending=""):
    """The files under version control in a folder of the checkout."""
    words = ["git", "ls-files", "-z", top]
    run = subprocess.run(words, cwd=ROOT, capture_output=True, check=False, text=True)
    if run.returncode:
        pytest.skip("not a git checkout")
    paths = [ROOT / name for name in run.stdout.split("\0") if name.endswith(ending)]
    return [path for path in paths if path.is_file()]


def test_text_files_name_no_place_on_somebodys_machine_and_end_in_one_newline():
    place = re.compile(rb"(?<![\w.>)}])/(home|Users|root|work|tmp|mnt)/\w")
    for path in tracked_files("."):
        text = path.read_bytes()
        if path.suffix not in {".png", ".jpg", ".gz"} and text:
            assert not place.search(text), path.name
            assert text.endswith(b"\n"), path.name
            assert not re.search(rb"[ \t\r]\n", text), path.name
