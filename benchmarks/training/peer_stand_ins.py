"""gsplat's own trainer on a machine without CUDA: what its file asks for, and what it gets instead.

Promise: nothing of gsplat's examples is kept here. The file is the user's, and it is run as its
users run it: with its own command line, presets, schedules and losses; for strategy grow with our
patch, in a copy. What it gets from here are
the views and points of a capture in memory, our rasteriser, our SSIM (both compute what gsplat's
CUDA code does), and things that do nothing in place of a viewer, logs and files that are never
asked for.

For a process of its own: modules stand in only while the file is imported, but functions that are
replaced stay so.
"""

from __future__ import annotations

import hashlib
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType, ModuleType, SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from splatseed.errors import MissingDependencyError, SceneNotFoundError
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.rendering import rasterization
from splatseed.splat.ssim import l1_and_ssim

__all__ = ["Capture", "Peer", "check_examples", "fused_ssim", "load_peer"]

VERSION = "v1.5.3"
DIGESTS = MappingProxyType(
    {
        "simple_trainer.py": "79319e1cd7404e4d1ba0c425634235c39e6054f0643b904a01feea6179462c05",
        "utils.py": "44a38b236940706705c9351b365be6bd21d49efc57dd695ba5a7e70055b959e1",
        "datasets/colmap.py": "2aa364ecfd2d7dd715ede5192fccd533982edf3be68b98008440a5aedf3b3fed",
        "datasets/normalize.py": "019be99afb9cf947842b42c149fb5baecd840847795b0d63e6596d86aa7f79b3",
    }
)
"""SHA-256 of the files of the version, line ends as in its repository."""
SCRIPT = "simple_trainer.py"
PATCH = Path(__file__).parents[2] / "examples" / "gsplat_grow.patch"
"""Ours, which users apply to it for strategy grow."""
FETCH = (
    f"Fetch it with git clone --depth 1 --branch {VERSION} "
    "https://github.com/nerfstudio-project/gsplat, and name its folder examples."
)
UNUSED = (
    "cv2", "nerfview", "sklearn", "torch.utils.tensorboard", "torchmetrics", "torchmetrics.image",
    "torchmetrics.image.lpip", "viser", "yaml",
)  # fmt: skip
"""Imported by its files and without work to do here: lenses without distortion, no files, no scores
of its own (one scorer serves both trainers)."""
PINHOLE = 1


@dataclass(frozen=True, eq=False)
class Capture:
    """What a trainer is given.

    Args:
        views: All that it may see, those included that it holds out itself.
        points: Its seeds, in the views' world.
    """

    views: Sequence[View]
    points: PointCloud


class Peer(NamedTuple):
    """gsplat's trainer, ready to train.

    Attributes:
        config: Its settings.
        make_runner: Reads the capture and makes the Gaussians, from a seed.
    """

    config: Any
    make_runner: Callable[[int], Any]


def check_examples(folder: Path | None) -> Path:
    """The folder, which holds the trainer's files as they are in the version.

    Raises:
        MissingDependencyError: No folder is named, or it is another version's.
        SceneNotFoundError: There is no such folder.
    """
    if folder is None:
        raise MissingDependencyError(
            f"gsplat's trainer, by --gsplat-examples (examples of gsplat {VERSION})",
            found="none named", fix=FETCH,
        )  # fmt: skip
    if not folder.is_dir():
        raise SceneNotFoundError(
            f"the folder examples of gsplat {VERSION}", found=f"none at {folder}", fix=FETCH
        )
    for name, digest in DIGESTS.items():
        if _digest(folder / name) != digest:
            found = "another version's" if (folder / name).is_file() else "no such file"
            raise MissingDependencyError(
                f"{folder / name} of gsplat {VERSION}", found=found, fix=FETCH
            )
    return folder


def _digest(path: Path) -> str:
    if not path.is_file():
        return ""
    return hashlib.sha256(path.read_bytes().replace(b"\r\n", b"\n")).hexdigest()


def load_peer(examples: Path, capture: Capture, folder: Path, options: Sequence[str]) -> Peer:
    """Run the trainer's file up to where it would start on a GPU.

    Args:
        examples: Where the file is.
        capture: What it shall read.
        folder: An empty one, which it takes for the capture's and writes to.
        options: Its command line, without those that say where things are.
    """
    _lay_out(capture, folder)
    caught: dict[str, Any] = {}
    _replace_functions(caught)
    places = ["--data-dir", folder, "--result-dir", folder / "result", "--data-factor", 1]
    sys.argv = [SCRIPT, *map(str, options), *map(str, places)]
    sys.path.insert(0, str(examples))
    script = examples / SCRIPT if options[0] != "grow" else _patched(examples, folder)
    with _standing_in(_modules(examples, capture, folder)):
        runpy.run_path(str(script), run_name="__main__")
    return Peer(caught["config"], partial(_make_runner, caught["main"], caught["config"]))


def _patched(examples: Path, folder: Path) -> Path:
    """A copy of the trainer's file with our patch, in a folder ``examples``."""
    script = folder / "examples" / SCRIPT
    script.parent.mkdir()
    script.write_bytes((examples / SCRIPT).read_bytes().replace(b"\r\n", b"\n"))
    subprocess.run(["git", "apply", "--unidiff-zero", str(PATCH)], cwd=folder, check=True)
    return script


def _make_runner(main: Any, config: Any, seed: int) -> Any:
    """Its Runner on the CPU; the rank within a machine shifts its seed and nothing else."""
    runner: Any = main.__globals__["Runner"]

    class OnCpu(runner):  # type: ignore[misc]  # known at run time only
        device = property(lambda _: "cpu", lambda *_: None)

    return OnCpu(seed, 0, 1, config)


def _lay_out(capture: Capture, folder: Path) -> None:
    """The files that its reader lists; what is in them comes from memory."""
    (folder / "sparse").mkdir()
    for view in capture.views:
        path = folder / "images" / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()


def _replace_functions(caught: dict[str, Any]) -> None:
    """Those that are there but want CUDA, or processes to read files in."""
    import_module("gsplat.rendering").rasterization = rasterization
    import_module("gsplat.distributed").cli = partial(_catch, caught)
    torch.utils.data.DataLoader = partial(_load_in_process, torch.utils.data.DataLoader)


def _modules(examples: Path, capture: Capture, folder: Path) -> dict[str, Inert]:
    """Modules that stand in, by name."""
    reader = Inert("imageio.v2", imread=Photographs(capture, folder))
    modules = (
        *(Inert(name) for name in UNUSED),
        Inert("pycolmap", SceneManager=partial(Manager, capture)),
        Inert("imageio", v2=reader),
        reader,
        Inert("sklearn.neighbors", NearestNeighbors=Neighbors),
        Inert("fused_ssim", fused_ssim=fused_ssim),
        Inert("tqdm", tqdm=Bar),
        # A package of this name is common, and would be found before a folder without __init__.py.
        Inert("datasets", __path__=[str(examples / "datasets")]),
    )
    return {module.__name__: module for module in modules}


@contextmanager
def _standing_in(modules: Mapping[str, ModuleType]) -> Iterator[None]:
    """For the block's time; PyTorch looks for some of these on its own later."""
    before = {name: sys.modules.get(name) for name in modules}
    sys.modules.update(modules)
    try:
        yield
    finally:
        for name, module in before.items():
            sys.modules.pop(name)
            if module is not None:
                sys.modules[name] = module


def _catch(caught: dict[str, Any], main: Any, config: Any, **_: object) -> None:
    """What would start its main on every GPU."""
    caught.update(main=main, config=config)


def _load_in_process(loader: Callable[..., Any], *args: Any, **options: Any) -> Any:
    """Without workers, as photographs are in memory; the order is drawn as with them."""
    return loader(
        *args, **{**options, "num_workers": 0, "persistent_workers": False, "pin_memory": False}
    )


class Nothing:
    """Made from anything; whatever it is told, nothing happens."""

    def __init__(self, *_: object, **__: object) -> None: ...

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None


class Inert(ModuleType):
    """A module in which every name that it was not given is a class that does nothing."""

    def __init__(self, name: str, **content: Any) -> None:
        super().__init__(name)
        vars(self).update(content)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return Nothing


class Bar(Nothing):
    """A progress bar that shows none."""

    def __init__(self, items: Any) -> None:
        self.items = items

    def __iter__(self) -> Iterator[Any]:
        return iter(self.items)


class Manager(Nothing):
    """Of the pycolmap before version 0.5, what gsplat reads; each view has a camera of its own."""

    def __init__(self, capture: Capture, _: str) -> None:
        points = capture.points
        self.images = {i: _image(i, view) for i, view in enumerate(capture.views)}
        self.cameras = {i: _camera(view) for i, view in enumerate(capture.views)}
        self.points3D, self.point3D_colors = points.xyz, points.rgb
        self.point3D_errors = np.zeros(len(points))
        # Who saw which point serves the depth loss only.
        self.name_to_image_id: Mapping[str, int] = {}
        self.point3D_id_to_images: Mapping[int, Any] = {}


def _image(index: int, view: View) -> SimpleNamespace:
    rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
    return SimpleNamespace(
        name=view.name, camera_id=index, tvec=translation, R=lambda: rotation
    )  # fmt: skip


def _camera(view: View) -> SimpleNamespace:
    K = view.K
    return SimpleNamespace(
        fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2],
        width=view.width, height=view.height, camera_type=PINHOLE,
    )  # fmt: skip


class Photographs:
    """Reads the views' pixels by the paths that were laid out for them."""

    def __init__(self, capture: Capture, folder: Path) -> None:
        self._pixels = {folder / "images" / view.name: view.photograph for view in capture.views}

    def __call__(self, path: str) -> np.ndarray:
        """The pixels, uint8 [H, W, 3]."""
        return self._pixels[Path(path)]


class Neighbors:
    """scikit-learn's search of neighbours, as far as it is used."""

    def __init__(self, n_neighbors: int, metric: str) -> None:
        if metric != "euclidean":
            raise NotImplementedError(metric)
        self.num = n_neighbors

    def fit(self, points: np.ndarray) -> Neighbors:
        """Search among these."""
        self.tree = cKDTree(points)
        return self

    def kneighbors(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances and indices, [N, num] each, nearest first."""
        return self.tree.query(points, k=self.num)


def fused_ssim(x: Tensor, y: Tensor, padding: str) -> Tensor:
    """Mean SSIM of two images [1, 3, H, W], valid windows only, differentiable in the first."""
    if padding != "valid" or len(x) != 1:
        raise NotImplementedError(f"{padding} padding, {len(x)} images")
    pair = (each[0].permute(1, 2, 0).contiguous() for each in (x, y))
    similarity: Tensor = _Ssim.apply(*pair)
    return similarity


class _Ssim(torch.autograd.Function):
    """The fused kernel of our loss, with no weight on the mean difference."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        _, similarity, gradient = l1_and_ssim(x.detach().numpy(), y.numpy(), 0.0, 1.0)
        ctx.save_for_backward(torch.from_numpy(-gradient))
        return torch.tensor(similarity)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * upstream[0], None
