"""The comparison with gsplat's trainer: what stands in for CUDA, on a stand-in for its files
too."""

from __future__ import annotations

import dataclasses
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseed.errors import MissingDependencyError, ParameterError, SceneNotFoundError
from splatseed.splat.metrics import l1_and_ssim_by_convolution
from splatseed.synthetic import make_capture, write_capture
from splatseed.views.view import load_split

ROOT = Path(__file__).parents[2]
MODULES = (
    "common.children",
    "training.peer_trainer",
    "training.peer_runs",
    "training.peer_stand_ins",
)

# In place of gsplat's files: they import what it imports and train, in as few lines as that takes.
TRAINER = """
import imageio, tqdm, tyro, viser, yaml
import torch
from dataclasses import dataclass, field
from datasets.colmap import Dataset, Parser
from fused_ssim import fused_ssim
from gsplat.distributed import cli
from gsplat.rendering import rasterization
from gsplat.strategy import DefaultStrategy, MCMCStrategy
from nerfview import RenderTabState
from torch.utils.tensorboard import SummaryWriter
from torchmetrics.image import PeakSignalNoiseRatio
from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
from utils import distances

class Tab(RenderTabState):
    server: viser.ViserServer

@dataclass
class Config:
    strategy: DefaultStrategy | MCMCStrategy
    data_dir: str = ""
    result_dir: str = ""
    data_factor: int = 4
    test_every: int = 8
    disable_viewer: bool = False
    disable_video: bool = False
    tb_every: int = 100
    eval_steps: list[int] = field(default_factory=lambda: [7])
    save_steps: list[int] = field(default_factory=lambda: [7])
    steps_scaler: float = 1.0
    max_steps: int = 30_000
    sh_degree_interval: int = 1000
    sh_degree: int = 0
    near_plane: float = 0.01
    far_plane: float = 1e10

class Runner:
    def __init__(self, local_rank, world_rank, world_size, cfg):
        torch.manual_seed(local_rank)
        self.cfg, self.device = cfg, f"cuda:{local_rank}"
        SummaryWriter(log_dir=cfg.result_dir).flush()
        self.lpips = LearnedPerceptualImagePatchSimilarity(net_type="alex").to(self.device)
        self.parser = Parser(cfg.data_dir)
        self.trainset = Dataset(self.parser, cfg.test_every)
        points = torch.from_numpy(self.parser.points)
        size = distances(points.numpy())[:, 1:].mean(axis=1)
        n = len(points)
        self.splats = torch.nn.ParameterDict({
            "means": points,
            "scales": torch.from_numpy(size).float().log()[:, None].repeat(1, 3),
            "quats": torch.rand(n, 4),
            "opacities": torch.zeros(n),
            "sh0": torch.zeros(n, 1, 3),
        }).to(self.device)
        self.optimizers = {k: torch.optim.Adam([v], 0.01) for k, v in self.splats.items()}
        cfg.strategy.check_sanity(self.splats, self.optimizers)
        self.state = cfg.strategy.initialize_state()

    def rasterize_splats(self, camtoworlds, **options):
        return rasterization(
            means=self.splats["means"], quats=self.splats["quats"],
            scales=self.splats["scales"].exp(), opacities=self.splats["opacities"].sigmoid(),
            colors=self.splats["sh0"], viewmats=torch.linalg.inv(camtoworlds),
            packed=False, **options,
        )

    def train(self):
        yaml.dump(vars(self.cfg), None)
        loader = torch.utils.data.DataLoader(
            self.trainset, shuffle=True, num_workers=4, persistent_workers=True, pin_memory=True
        )
        for step in (bar := tqdm.tqdm(range(self.cfg.max_steps))):
            data = next(iter(loader))
            truth = data["image"].to(self.device) / 255.0
            image, _, info = self.rasterize_splats(
                data["camtoworld"], Ks=data["K"], sh_degree=0,
                width=truth.shape[2], height=truth.shape[1],
            )
            known = dict(params=self.splats, optimizers=self.optimizers, state=self.state)
            self.cfg.strategy.step_pre_backward(**known, step=step, info=info)
            pair = (each.permute(0, 3, 1, 2) for each in (image, truth))
            loss = (image - truth).abs().mean() + 1 - fused_ssim(*pair, padding="valid")
            loss.backward()
            for optimizer in self.optimizers.values():
                optimizer.step()
                optimizer.zero_grad()
            rate = {} if isinstance(self.cfg.strategy, DefaultStrategy) else {"lr": 1e-4}
            self.cfg.strategy.step_post_backward(**known, step=step, info=info, **rate)
            bar.set_description(f"{loss.item()}")

def main(local_rank, world_rank, world_size, cfg):
    raise AssertionError("on every GPU")

if __name__ == "__main__":
    cfg = tyro.extras.overridable_config_cli({
        "default": ("", Config(strategy=DefaultStrategy())),
        "mcmc": ("", Config(strategy=MCMCStrategy())),
    })
    assert cfg.disable_viewer and cfg.disable_video and cfg.data_factor == 1
    cfg.max_steps = int(cfg.max_steps * cfg.steps_scaler)
    cfg.strategy.refine_start_iter = 2
    cfg.strategy.refine_every = int(cfg.strategy.refine_every * cfg.steps_scaler)
    cli(main, cfg, verbose=True)
"""
READER = """
import os
import cv2
import imageio.v2 as imageio
import numpy as np
import torch
from pycolmap import SceneManager
from tqdm import tqdm

class Parser:
    def __init__(self, folder):
        assert os.path.exists(os.path.join(folder, "sparse"))
        manager = SceneManager(os.path.join(folder, "sparse/"))
        manager.load_cameras()
        manager.load_images()
        manager.load_points3D()
        images = sorted(manager.images.values(), key=lambda image: image.name)
        bottom = np.array([[0.0, 0, 0, 1]])
        self.image_names = [image.name for image in images]
        self.paths = [os.path.join(folder, "images", name) for name in self.image_names]
        assert all(os.path.isfile(path) for path in self.paths)
        self.camtoworlds = [
            np.linalg.inv(np.vstack([np.hstack([i.R(), i.tvec.reshape(3, 1)]), bottom]))
            for i in images
        ]
        cameras = [manager.cameras[image.camera_id] for image in images]
        self.Ks = [np.array([[c.fx, 0, c.cx], [0, c.fy, c.cy], [0, 0, 1]]) for c in cameras]
        self.points = manager.points3D.astype(np.float32)
        assert len(manager.point3D_colors) == len(manager.point3D_errors) == len(self.points)

class Dataset:
    def __init__(self, parser, test_every):
        self.parser = parser
        indices = np.arange(len(parser.image_names))
        self.indices = indices[indices % test_every != 0]

    def __len__(self):
        return len(self.indices)

    def __getitem__(self, item):
        i = self.indices[item]
        return {
            "K": torch.from_numpy(self.parser.Ks[i]).float(),
            "camtoworld": torch.from_numpy(self.parser.camtoworlds[i]).float(),
            "image": torch.from_numpy(imageio.imread(self.parser.paths[i])[..., :3]).float(),
        }
"""
TOOLS = """
from sklearn.neighbors import NearestNeighbors

def distances(points):
    return NearestNeighbors(n_neighbors=4, metric="euclidean").fit(points).kneighbors(points)[0]
"""


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    path = tmp_path_factory.mktemp("room") / "room"
    return write_capture(make_capture(0, num_views=12, width=96, height=72), path)


@pytest.fixture(scope="module")
def examples(tmp_path_factory):
    folder = tmp_path_factory.mktemp("gsplat") / "examples"
    (folder / "datasets").mkdir(parents=True)
    (folder / "simple_trainer.py").write_text(TRAINER)
    (folder / "datasets" / "colmap.py").write_text(READER)
    (folder / "utils.py").write_text(TOOLS)
    return folder


def _train(bench, room, examples, steps, **more):
    settings = {"strategy": "default", "max_steps": steps, "data_factor": 2, "seed": 1, **more}
    capped = settings["strategy"] == "default" and "cap_max" in settings
    return bench.children.call(
        "benchmarks.training.peer_runs:train_peer", threads=1, scene=str(room), split="validation",
        settings=settings, examples=str(examples), capped=capped,
    )  # fmt: skip


@pytest.fixture(scope="module")
def short(bench, room, examples):
    """A run of one step."""
    return _train(bench, room, examples, 1)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_the_peers_file_trains_on_our_views_to_the_cap_and_is_scored(
    bench, room, examples, short, strategy
):
    cap = short["gaussians"] + 20
    long = _train(bench, room, examples, 60, strategy=strategy, cap_max=cap)
    assert short["gaussians"] < long["gaussians"] <= cap
    assert long["seconds"] > short["seconds"] > 0
    if strategy == "default":  # mcmc's noise takes longer than this to be worth anything
        assert long["psnr"] > short["psnr"] + 2
        assert long["ssim"] > short["ssim"]


def test_validation_views_are_of_the_training_views(bench, room):
    whole = bench.peer_runs.read_scene(room, "test")
    within = bench.peer_runs.read_scene(room, "validation")
    train, test = load_split(whole)
    kept, held_out = load_split(within)
    names = [view.name for view in train]
    assert [view.name for view in held_out] == names[::8]
    assert {view.name for view in (*kept, *held_out)} == set(names)
    assert not {view.name for view in test} & set(names)


def test_ssim_and_its_gradient_are_those_of_convolutions(bench):
    torch.manual_seed(0)
    x, y = torch.rand(1, 3, 20, 31, requires_grad=True), torch.rand(1, 3, 20, 31)
    found = bench.peer_stand_ins.fused_ssim(x, y, padding="valid")
    (2 * found).backward()
    pair = x[0].permute(1, 2, 0), y[0].permute(1, 2, 0)
    _, expected, slopes = l1_and_ssim_by_convolution(*pair, 0.0, 1.0)  # of 1 - SSIM
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(x.grad[0].permute(1, 2, 0), -2 * slopes, atol=1e-7, rtol=1e-4)


def test_modules_stand_in_for_a_while_only(bench):
    before = dict(sys.modules)
    modules = {"numpy": bench.peer_stand_ins.Inert("numpy"), "no_such": np}
    with bench.peer_stand_ins._standing_in(modules):
        anything = sys.modules["numpy"].anything("is", made="of anything")
        assert anything.told("anything") is None
        assert sys.modules["no_such"] is np
    assert sys.modules == before


def test_both_trainers_get_the_same_settings(bench):
    peer_trainer = bench.peer_trainer
    settings = peer_trainer.Settings(Path(), max_steps=50, cap_max=900, data_factor=3)
    for arm in peer_trainer.ARMS:
        chosen = peer_trainer.train_settings(arm, 4, settings)
        expected = 900 if "mcmc" in arm else None
        assert (chosen["cap_max"], chosen["max_steps"], chosen["seed"]) == (expected, 50, 4)
        held = dataclasses.replace(settings, cap_default=True)
        assert peer_trainer.train_settings(arm, 4, held)["cap_max"] == 900


def test_our_arms_are_the_peers_strategies_in_both_conventions(bench):
    assert set(bench.peer_trainer.OURS) == {
        "splatseed-default", "splatseed-default-3dgs", "splatseed-mcmc", "splatseed-mcmc-3dgs"
    }  # fmt: skip


def test_a_run_that_fails_does_not_cost_the_others(bench, monkeypatch, capsys):
    def run_arm(arm, seed, *_):
        if (arm, seed) == ("gsplat-default", 0):
            raise bench.children.ChildError("a run", found="none", fix="Try again.")
        return {"psnr": float(seed)}

    monkeypatch.setattr(bench.peer_trainer, "run_arm", run_arm)
    settings = bench.peer_trainer.Settings(
        Path(), repeats=2, arms=("gsplat-default", "splatseed-default")
    )
    results = bench.peer_trainer.compare(Path(), settings)
    assert results["gsplat-default"] == [{"psnr": 1.0}]
    assert results["splatseed-default"] == [{"psnr": 0.0}, {"psnr": 1.0}]
    assert "SKIPPED gsplat-default, seed 0: expected a run" in capsys.readouterr().out


def test_the_table_has_means_and_their_spread(bench):
    runs = [
        {"psnr": 20.0, "ssim": 0.5, "gaussians": 1000, "seconds": 10.0},
        {"psnr": 21.0, "ssim": 0.7, "gaussians": 2001, "seconds": 11.4},
    ]
    (several,) = bench.peer_trainer.rows({"splatseed-mcmc-3dgs": runs})
    assert several == ["splatseed", "mcmc-3dgs", "20.50 ± 0.71", "0.6000 ± 0.1414", "1,500", "11"]
    (one,) = bench.peer_trainer.rows({"gsplat-default": runs[:1]})
    assert one == ["gsplat", "default", "20.00", "0.5000", "1,000", "10"]


def test_a_folder_that_is_not_the_peers_is_refused(bench, examples, tmp_path):
    check = bench.peer_stand_ins.check_examples
    with pytest.raises(MissingDependencyError, match=r"--gsplat-examples.*none named.*git clone"):
        check(None)
    with pytest.raises(SceneNotFoundError, match="none at"):
        check(tmp_path / "none")
    with pytest.raises(MissingDependencyError, match="no such file"):
        check(tmp_path)
    with pytest.raises(MissingDependencyError, match="another version's"):
        check(examples)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"arms": ("gsplat-default", "brush")}, "found brush"),
        ({"repeats": 0}, "--repeats of 1 or more"),
        ({"cap_default": True}, "--cap-max with --cap-default"),
        ({"max_steps": 0}, "--max-steps"),
    ],
)
def test_options_that_make_no_sense_are_refused(bench, wrong, says):
    with pytest.raises(ParameterError, match=says):
        bench.peer_trainer.Settings(Path(), **wrong)


def test_the_script_says_what_is_missing_without_a_traceback(bench, room, monkeypatch):
    """Run in this process: one of its own would wait for PyTorch again."""
    words = ["--scene", str(room), "--gsplat-examples", "none"]
    monkeypatch.setattr(sys, "argv", ["peer_trainer", *words])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(bench.peer_trainer.__file__, run_name="__main__")
    # A text is printed on stderr, and the exit code is 1.
    assert stop.value.code.startswith("expected the folder examples of gsplat v1.5.3")
