"""Features and matches: the part that both pipelines share.

The database is written before any feature is detected, images with their cameras, so that ids are
ours: camera i has rig i, image i has frame i, counted from 1. pycolmap then only adds to it.
Progress is read from the database through pycolmap too: Python's sqlite3 is another copy of SQLite,
and two copies in one process drop each other's file locks and corrupt the file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatseed.errors import SceneFormatError
from splatseed.sfm.photos import name_some
from splatseed.sfm.settings import Settings
from splatseed.sfm.stages import Stages

_BLOCK_IMAGES = 16  # matches are committed, and progress is visible, per block of 16 x 16 pairs


@dataclass(frozen=True)
class Run:
    """Shared by the stages of one run.

    Args:
        stages: Runs and times them.
        settings: How to run them.
        image_dir: Where the photographs are.
        work: A scratch folder, removed at the end.
    """

    stages: Stages
    settings: Settings
    image_dir: Path
    work: Path

    @property
    def pycolmap(self) -> Any:
        """The pycolmap module."""
        return self.stages.pycolmap

    @property
    def database(self) -> Path:
        """The feature database."""
        return self.work / "database.db"

    @property
    def device(self) -> Any:
        """The device in pycolmap's terms."""
        return getattr(self.pycolmap.Device, self.settings.device)


def write_database(run: Run, cameras: Sequence[Any], images: Sequence[Any]) -> None:
    """Create the database with ``cameras`` and ``images`` (pycolmap's, with their ids set)."""
    pycolmap = run.pycolmap
    with pycolmap.Database.open(run.database) as database:
        for camera in cameras:
            database.write_camera(camera, use_camera_id=True)
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            database.write_rig(rig, use_rig_id=True)
        for image in images:
            database.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=image.image_id, rig_id=image.camera_id)
            frame.add_data_id(image.data_id)
            database.write_frame(frame, use_frame_id=True)


def find_features(run: Run, names: Sequence[str]) -> None:
    """Add SIFT features of every image to the database.

    Raises:
        SceneFormatError: pycolmap could not use one of the images.
    """
    pycolmap, settings = run.pycolmap, run.settings
    options = pycolmap.FeatureExtractionOptions()
    options.max_image_size = settings.max_image_size
    options.num_threads = settings.threads
    image_ids = range(1, len(names) + 1)
    with pycolmap.Database.open(run.database) as database:
        run.stages.run(
            "features",
            lambda: pycolmap.extract_features(
                run.database,
                run.image_dir,
                image_names=names,
                extraction_options=options,
                device=run.device,
            ),
            lambda: sum(map(database.exists_keypoints, image_ids)),
            len(names),
        )
        done = list(map(database.exists_keypoints, image_ids))
    _check_all_read(run, [name for name, read in zip(names, done, strict=True) if not read])


def _check_all_read(run: Run, skipped: Sequence[str]) -> None:
    if skipped:
        raise SceneFormatError(
            f"pycolmap to read all images of {run.image_dir}",
            found=f"{len(skipped)} that it skipped: {name_some(skipped)}",
            fix="Export them again as 8-bit JPEG or PNG, or take them out of the folder.",
        )


def match_features(run: Run) -> None:
    """Match the features of pairs of images and verify the matches geometrically."""
    pycolmap, settings = run.pycolmap, run.settings
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = settings.threads
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = settings.seed
    match, pairing, generator = _pairing(run)
    with pycolmap.Database.open(run.database) as database:
        num_pairs = len(set(generator(pairing, database).all_pairs()))
        run.stages.run(
            "matching",
            lambda: match(
                run.database,
                matching_options=matching,
                pairing_options=pairing,
                verification_options=verification,
                device=run.device,
            ),
            database.num_matched_image_pairs,
            num_pairs,
        )


def _pairing(run: Run) -> tuple[Any, Any, Any]:
    """The matching function of pycolmap, its pairing options, and the generator of its pairs."""
    pycolmap = run.pycolmap
    if run.settings.matcher == "exhaustive":
        options = pycolmap.ExhaustivePairingOptions()
        options.block_size = _BLOCK_IMAGES
        return pycolmap.match_exhaustive, options, pycolmap.ExhaustivePairGenerator
    options = pycolmap.SequentialPairingOptions()
    return pycolmap.match_sequential, options, pycolmap.SequentialPairGenerator
