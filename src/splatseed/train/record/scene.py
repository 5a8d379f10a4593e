"""The scene that a run trains: as it was read, or at refined poses, which its folder keeps.

Promise: a resumed run has the poses and points that it began with.
"""

from __future__ import annotations

from collections.abc import Callable

from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.io.output.earlier import was_upsampled
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.train.record.folder import RunFolder
from splatseed.train.settings import Reading


def scene_as_read(
    scene: Scene,
    reading: Reading,
    begun: RunFolder | None,
    seed: int,
    note: Callable[[str], None],
    progress: Progress,
) -> Scene:
    """The scene without its depth maps, and at refined poses, where that is asked for.

    Args:
        scene: The scene as the user names it.
        reading: What is asked for.
        begun: The folder of the run that is resumed, if one is.
        seed: Seed of every random choice.
        note: Called with what was done, in a sentence.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: Refined poses would replace seeds, or the resumed run began with another
            scene.
        SceneNotFoundError: There are no photographs, or the run has lost its refined poses.
        SceneFormatError: The run's refined poses are damaged.
        ReconstructionError: The poses drifted, or no point could be triangulated.
        MissingDependencyError: pycolmap is absent.
    """
    if reading.ignore_depth:
        scene = scene.replace(depths=None)
    if not reading.refine_poses:
        return scene
    from splatseed.sfm.refining import refined, with_refined  # noqa: PLC0415  (loads with its use)

    if begun is not None:
        found = load_scene(begun.scene)
        _check_same_images(scene, found, begun)
        return with_refined(scene, found)
    if was_upsampled(scene):
        raise ParameterError(
            "a scene that splatseed has not added points to, with --refine-poses",
            found="seeds, which triangulated points would replace",
            fix="Name the scene that they were made from, or refine before seeds are made: "
            "splatseed upsample SCENE --refine-poses -o OUT.",
        )
    scene, told = refined(scene, seed, progress)
    note(told)
    return scene


def _check_same_images(scene: Scene, found: Scene, begun: RunFolder) -> None:
    if {image.name for image in scene.images} != {image.name for image in found.images}:
        where = scene.source.root if scene.source else "the scene"
        raise ParameterError(
            f"the scene that the run began with ({begun.read_config().get('scene')}, says "
            f"{begun.config})",
            found=f"other images in {where}",
            fix="Name that scene, or start again with --overwrite.",
        )
