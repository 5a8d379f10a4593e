"""What the manifest of an output records of its scene, so that it is read as the same scene.

Its files alone would be read with other test views, or with masks that the scene does not use.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from splatseed.io.masks import ALPHA, with_own_masks
from splatseed.io.staging import read_manifest
from splatseed.scene import Masks, Scene

_ABSENT = "absent"
"""The manifest's key for ``Scene.absent``."""
_TRANSPARENT, _BLACK, _LEFT_OUT = "transparent", "black", "masked"
"""The manifest's entries for masks without ``Masks.alpha``, and with it by the user's choice."""
_MASKED, _NOTHING = "masks", "none"
"""The manifest's entry for a scene without masks, whatever lies near its photographs."""


def facts_for_reading(scene: Scene) -> dict[str, Any]:
    """Return entries of an output's manifest by which ``load_scene`` reads it as this scene."""
    facts: dict[str, Any] = {}
    if scene.absent:  # so that the others train or test as before
        facts[_ABSENT] = list(scene.absent)
    if scene.masks is None and scene.source.image_dir:
        facts[_MASKED] = _NOTHING  # else masks near the photographs would count again
    if scene.masks and not scene.masks.alpha:  # else transparent pixels might be masked
        facts[_TRANSPARENT] = _BLACK
    if scene.masks and scene.masks.choice == ALPHA:  # else they might be empty
        facts[_TRANSPARENT] = _LEFT_OUT
    return facts


def restore_absent(scene: Scene) -> Scene:
    """Add the absent images that the manifest of a scene lists."""
    noted = read_manifest(scene.source.root).get(_ABSENT)
    if not isinstance(noted, list) or not all(isinstance(name, str) for name in noted):
        return scene
    known = {*scene.absent, *(image.name for image in scene.images)}
    return scene.replace(absent=(*scene.absent, *(name for name in noted if name not in known)))


def with_recorded_masks(scene: Scene) -> Scene:
    """Attach the masks near the photographs, as far as the manifest of a scene lets them count."""
    manifest = read_manifest(scene.source.root)
    if manifest.get(_MASKED) == _NOTHING:
        return scene.replace(masks=None)
    masks = scene.masks or Masks({})
    if manifest.get(_TRANSPARENT) == _BLACK:
        scene = scene.replace(masks=replace(masks, alpha=False))
    elif manifest.get(_TRANSPARENT) == _LEFT_OUT:
        scene = scene.replace(masks=replace(masks, alpha=True, choice=ALPHA))
    return with_own_masks(scene)
