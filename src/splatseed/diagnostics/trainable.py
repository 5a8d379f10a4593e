"""What keeps a scene from being trained, for the commands that are advised.

Promise: no photograph is opened.
"""

from __future__ import annotations

from splatseed.io.files import odd_kind
from splatseed.literal import agreeing, visible
from splatseed.scene import Scene


def untrainable(scene: Scene) -> str:
    """Why no trainer can use the scene, and what to do, in a sentence; empty if nothing is missing.

    Lens distortion is no such reason: it can be removed (``is_distorted``).
    """
    if not scene.images:
        return "Points alone cannot be trained: that needs their scene's photographs and cameras."
    folder = scene.source.image_dir if scene.source else None
    if folder is None:
        return "Training needs the photographs: put them beside the model in a folder named images."
    missing = [image.name for image in scene.images if not (folder / image.name).is_file()]
    if not missing:
        return ""
    needs = f"Training needs all {len(scene.images):,} photographs"
    if kind := odd_kind(folder / missing[0]):
        return f"{needs}: {visible(missing[0])} is {kind}."
    which = agreeing(len(missing), "", f"and {len(missing) - 1:,} more ")
    return f"{needs}: put {visible(missing[0])} {which}into {visible(folder)}."


def is_distorted(scene: Scene) -> bool:
    """Whether any of the images' cameras has lens distortion."""
    return any(image.intrinsics.has_distortion for image in scene.images)
