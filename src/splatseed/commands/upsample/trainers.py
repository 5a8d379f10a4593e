"""The commands that train a written scene, with splatseed and with each other 3DGS trainer."""

from __future__ import annotations

from pathlib import Path

from splatseed.literal import quoted
from splatseed.scene import SceneFormat

__all__ = ["training_commands"]


def training_commands(path: Path, written_format: SceneFormat) -> list[tuple[str, str]]:
    """(trainer, command) for every trainer, all of which read the scene at ``path`` unchanged.

    Args:
        path: The scene folder that was written.
        written_format: "colmap" or "transforms": gsplat's examples, graphdeco's code and LichtFeld
            Studio read only the former.

    Example:
        >>> dict(training_commands(Path("/data/out"), "colmap"))["graphdeco"]
        'python train.py -s /data/out -m /data/out-graphdeco --eval'
    """
    # Trainers are run from their own checkouts, so a relative path would miss.
    path = path.resolve()
    scene = quoted(path)
    run, *result = (
        quoted(f"{path}-{name}") for name in ("run", "gsplat", "graphdeco", "lichtfeld")
    )
    ours = ("splatseed", f"splatseed train {scene} -o {run}")
    brush = ("Brush", f"brush {scene} --with-viewer")
    opensplat = ("OpenSplat", f"./opensplat {scene} -n 30000")
    if written_format == "transforms":
        return [ours, ("nerfstudio", f"ns-train splatfacto --data {scene}"), brush, opensplat]
    gsplat = f"--data_dir {scene} --data_factor 1 --result_dir {result[0]}"
    nerfstudio = "colmap --colmap-path sparse/0 --downscale-factor 1"
    return [
        ours,
        ("gsplat", f"python examples/simple_trainer.py default {gsplat}"),
        ("graphdeco", f"python train.py -s {scene} -m {result[1]} --eval"),
        ("nerfstudio", f"ns-train splatfacto --data {scene} {nerfstudio}"),
        brush,
        opensplat,
        ("LichtFeld", f"./build/LichtFeld-Studio -d {scene} -o {result[2]}"),
    ]
