"""Resumable work of a run: features, matches and models in ``OUTPUT_sfm``.

The folder stays if a run fails or is killed, and the same command resumes from it. A successful run
removes it, unless ``resume`` keeps it for further runs. Whatever still applies is used:
features of each photograph whose file, mask and size are unchanged, matches of two such
photographs, verified matches with the same cameras and seed, models with the same matcher.

The *key* of a run fingerprints what these depend on. The manifest holds the key of what the folder
contains, and names its images in the order of their ids.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from splatseed.camera import Intrinsics
from splatseed.findings import Finding
from splatseed.io.staging import MANIFEST, locked, read_manifest, remove, write_json
from splatseed.progress import Note
from splatseed.requirements import version_of
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Masks
from splatseed.sfm.cameras import Photos
from splatseed.text import quoted

KIND = "sfm work"
DATABASE, MODELS = "database.db", "models"
COMPLETE = "complete"  # file in the folder of models that marks them as finished
_KEEP, _IMAGES = "keep", "images"  # further entries of the manifest


class WorkKey(NamedTuple):
    """Fingerprints of what the contents of a folder depend on."""

    features: Mapping[str, str]  # by photograph
    verified: str  # verified matches, given the features
    models: str  # models, given all others


class WorkFolder(NamedTuple):
    """The folder, the key of the run, and what an earlier run left."""

    folder: Path
    key: WorkKey
    unchanged: bool = False  # the database is of the same photographs and cameras
    reusable: frozenset[str] = frozenset()  # photographs whose features and matches apply

    @property
    def image_names(self) -> list[str]:
        """The names of the database's images by id, if a run has written them."""
        names = read_manifest(self.folder).get(_IMAGES)
        return names if isinstance(names, list) else []

    def set_contents(self, image_names: Sequence[str]) -> None:
        """Record that the database is of the run's photographs; names are in order of ids."""
        _write(self.folder, self.key, {_IMAGES: list(image_names)})


def work_key(
    photos: Photos,
    cameras: Iterable[tuple[Sequence[str], Intrinsics | str]],
    masks: Masks | None,
    seed: int,
    *,
    features: Sequence[object] = (),
    pairs: Sequence[object] = (),
) -> WorkKey:
    """Fingerprint the inputs of features, verified matches and models.

    Args:
        photos: The photographs.
        cameras: For each camera, the names of its photographs, and its intrinsics or model.
        masks: Their masks.
        seed: The seed of verification and mapping.
        features: Settings of features.
        pairs: Settings of the choice of pairs.
    """
    by_name, lenses = dict[str, str](), list[object]()
    for names, lens in cameras:
        for name in names:
            facts = (photos[name].digest, *_mask_facts(masks, name))
            by_name[name] = _digest([version_of("pycolmap"), *features, *facts])
        lenses += [*names, lens if isinstance(lens, str) else (lens.model, lens.params)]
    verified = _digest([*lenses, seed])
    return WorkKey(by_name, verified, _digest([*sorted(by_name.items()), verified, *pairs]))


def _mask_facts(masks: Masks | None, name: str) -> tuple[object, ...]:
    if masks is None:
        return ()
    path, flags = masks.files.get(name), (masks.inverted, masks.alpha)
    # By content: masks of panoramas are cut anew by each run.
    return (*flags, *([fingerprint(path.read_bytes())] if path and path.is_file() else []))


def _digest(facts: Sequence[object]) -> str:
    return fingerprint("\n".join(map(repr, facts)).encode())


@contextmanager
def resumable_work(
    output: Path, key: WorkKey, note: Note, *, resume: bool = False
) -> Iterator[WorkFolder | None]:
    """Yield the work folder of an output; it is kept if the block fails after work started.

    ``resume`` keeps it after success as well, in this and later runs. Yields None if the path is
    taken or another run has locked the folder.
    """
    target = output.resolve()
    folder = target.with_name(f"{target.name}_sfm")
    with ExitStack() as stack:
        try:
            if folder.exists() and read_manifest(folder).get("command") != KIND:
                raise FileExistsError
            folder.mkdir(exist_ok=True)
            stack.enter_context(locked(folder))
        except OSError:
            text = f"{quoted(folder)} is not free, so that nothing of this run can be kept."
            note(Finding("work-not-kept", text))
            yield None
            return
        resume = resume or bool(read_manifest(folder).get(_KEEP))
        kept = _prepare(folder, key, note, keep=resume)
        try:
            yield kept
        except BaseException as error:
            if not (folder / DATABASE).exists():
                remove(folder)
            elif isinstance(error, KeyboardInterrupt):
                text = f"The same command resumes from {quoted(folder)}."
                note(Finding("work-kept", text, "info"))
            raise
        if resume:
            size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
            text = (
                f"Features and matches are kept in {quoted(folder)}, {size / 2**20:,.0f} MB, for "
            )
            text += "runs with further photographs or other options; it may be deleted."
            note(Finding("work-kept", text, "info"))
        else:
            remove(folder)


def _prepare(folder: Path, key: WorkKey, note: Note, *, keep: bool) -> WorkFolder:
    """Find out what an earlier run left that applies, and remove models that do not."""
    before: Mapping[str, Any] = read_manifest(folder)
    old = before.get("features") if (folder / DATABASE).is_file() else {}
    old = old if isinstance(old, dict) else {}
    reusable = {name: each for name, each in key.features.items() if old.get(name) == each}
    same = bool(old) and old == key.features
    unchanged = same and before.get("verified") == key.verified
    where, number, total = quoted(folder), len(reusable), len(key.features)
    if not unchanged or before.get("models") != key.models:
        remove(folder / MODELS)
    if unchanged and (folder / MODELS / COMPLETE).is_file():
        text = f"Resumes from the features, matches and models in {where}."
    elif unchanged:
        text = f"Resumes from the features and matches in {where}."
    elif reusable:
        those = "The" if same else f"{number:,} of {total:,} photographs are as before: their"
        text = f"{those} features and matches in {where} are used."
    elif old:
        text = f"The work in {where} is of other photographs or masks: started again."
    else:
        text = ""
    if text:
        note(Finding("resumed-work", text, "info"))
    # Until the database is of this run, the manifest vouches only for what both have in common.
    now = key if unchanged else WorkKey(reusable, "", "")
    images = {_IMAGES: before[_IMAGES]} if _IMAGES in before and (old or unchanged) else {}
    _write(folder, now, {**images, **({_KEEP: True} if keep else {})})
    return WorkFolder(folder, key, unchanged, frozenset(reusable))


def _write(folder: Path, key: WorkKey, further: Mapping[str, object]) -> None:
    kept = {_KEEP: True} if read_manifest(folder).get(_KEEP) else {}
    write_json(folder / MANIFEST, {"command": KIND, **key._asdict(), **kept, **further})
