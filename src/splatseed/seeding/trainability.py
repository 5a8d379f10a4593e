"""Whether a scene can be trained, and what is missing."""

from __future__ import annotations

from splatseed.io.files import special_kind
from splatseed.scene import Scene
from splatseed.text import agreeing, visible


def untrainable(scene: Scene) -> str:
    """Explain in a sentence why no trainer can use the scene; empty if one can.

    Lens distortion is not a reason, as it can be removed (``is_distorted``).
    """
    if not scene.images:
        return "Points alone cannot be trained: training needs photographs and cameras."
    if not all(scene.split()):
        return "Training needs at least two photographs, one to train on and one to test."
    folder = scene.source.image_dir
    if folder is None:
        return "Training needs the photographs: put them beside the model in a folder named images."
    missing = [image.name for image in scene.images if not image.has_photograph]
    if 2 * len(missing) <= len(scene.images):
        return ""
    needs = f"Training needs at least half of the {len(scene.images):,} photographs"
    if kind := special_kind(folder / missing[0]):
        return f"{needs}: {visible(missing[0])} is {kind}."
    which = agreeing(len(missing), "", f"and {len(missing) - 1:,} more ")
    return f"{needs}: put {visible(missing[0])} {which}into {visible(folder)}."


def is_distorted(scene: Scene) -> bool:
    """Whether any camera has lens distortion."""
    return any(image.intrinsics.has_distortion for image in scene.images)
