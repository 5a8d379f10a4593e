"""Options of ``splatseed upsample`` that are refused before anything is read."""

from __future__ import annotations

from typing import TYPE_CHECKING

from splatseed.commands.options import check_least
from splatseed.errors import ParameterError
from splatseed.literal import quoted

if TYPE_CHECKING:
    from splatseed.commands.upsample.command import Options

FILES = (".ply", ".las", ".laz", ".e57", ".pcd", ".xyz", ".pts", ".npz", ".bin", ".txt")
"""Suffixes by which somebody means a file of points."""
COVERING = ("auto", "cover")
"""Methods that leave no gaps for --cover."""


def check_options(options: Options) -> None:
    """Refuse options out of their range, and those that another makes pointless.

    Raises:
        ParameterError: There is such an option.
    """
    check_least(options, 1, "num_points", "jobs", "tile_points")
    check_least(options, 0, "seed")
    if options.output.suffix.lower() in FILES and not options.output.is_dir():
        raise ParameterError(
            "a folder after -o, as a whole scene is written",
            found=f"{options.output}, the name of a file",
            fix=f"Pass -o {quoted(options.output.with_suffix(''))}: the points lie there as a .ply "
            "too.",
        )
    if options.address is not None and options.executor != "ray":
        raise ParameterError("--executor ray with --address", found="local", fix="Add it.")
    if options.cover_cell is None:
        return
    if options.cover_cell < 1:
        found = f"{options.cover_cell}"
        raise ParameterError("--cover of 1 or more", found=found, fix="Try --cover 8.")
    if options.method in COVERING:
        raise ParameterError(
            f"--{options.method}.cell for method {options.method}, which covers by itself",
            found=f"--cover {options.cover_cell}",
            fix=f"Say --{options.method}.cell {options.cover_cell} instead.",
        )
