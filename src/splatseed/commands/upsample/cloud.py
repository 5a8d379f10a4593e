"""The part of ``splatseed upsample`` that brings clouds: which files, in which frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from splatseed.errors import ParameterError
from splatseed.io.transform_file import read_cloud_transform
from splatseed.scene import Scene
from splatseed.similarity import Similarity

if TYPE_CHECKING:
    from splatseed.seeding.clouds.method import Cloud, GivenClouds

__all__ = ["CLOUD", "Bringing", "cloud_method", "settle_cloud"]

CLOUD = "cloud"
BESIDE = (CLOUD, "auto", "stereo", "cover", "depth")
"""Methods that --cloud can be combined with."""


class Bringing(NamedTuple):
    """The options about clouds."""

    files: tuple[Path, ...] = ()
    transform: Path | None = None
    align: bool = False
    recenter: bool = False

    @property
    def provenance(self) -> dict[str, object]:
        """For ``splatseed.json``."""
        return {
            "files": [str(path.resolve()) for path in self.files],
            "transform": None if self.transform is None else str(self.transform.resolve()),
            "align": self.align,
            "recenter": self.recenter,
        }


def settle_cloud(options: Any, arguments: Sequence[str]) -> Any:
    """The options, with what --cloud changes about those that were not named.

    Args:
        options: As they were parsed.
        arguments: The words of the command line.

    Raises:
        ParameterError: Options for a cloud without one, or that exclude each other.
    """
    given = options.cloud_files
    if not given:
        unused = options.cloud_transform is not None or options.recenter
        if unused or options.method == CLOUD:
            raise ParameterError("--cloud FILE", found="none", fix="Name the scan.")
        return options
    named = any(word.partition("=")[0] == "--method" for word in arguments)
    method = options.method if named else CLOUD
    if method not in BESIDE:
        raise ParameterError(
            f"--method {', '.join(BESIDE[:-1])} or {BESIDE[-1]} with --cloud",
            found=method,
            fix="Leave --method out for the cloud's points alone: interpolating needs no scan.",
        )
    asked = "--align" in arguments
    if asked and options.cloud_transform is not None:
        raise ParameterError("--align or --transform", found="both", fix="Leave one of them out.")
    return dataclasses.replace(options, method=method, cloud_align=asked)


def cloud_method(
    bringing: Bringing, scene: Scene, method: Cloud, found: Similarity | None = None
) -> GivenClouds:
    """The method ``cloud`` with its files and their transform.

    Raises:
        SceneNotFoundError: There is no such transform.
        SceneFormatError: It is no similarity.
    """
    transform = found
    if bringing.transform is not None:
        transform = read_cloud_transform(bringing.transform, scene)
    return method.of(*bringing.files, transform=transform)
