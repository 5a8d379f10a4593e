"""Images whose pose or camera is not finite: a scene leaves them out, if it has enough others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

from splatseed.errors import SceneFormatError
from splatseed.text import agreeing, name_some


class NotFiniteError(SceneFormatError):
    """A camera or a pose of NaN, infinity or zeros: other images are usable without this one."""


Unusable: TypeAlias = dict[Any, NotFiniteError]
"""What is wrong with records that are left out, by the camera's id or the image's name."""


def check_enough(unusable: Mapping[str, NotFiniteError], used: int) -> None:
    """Raise what is wrong with the first unusable image, if fewer than half can be used."""
    if len(unusable) > used:
        raise next(iter(unusable.values()))


def unusable_warning(unusable: Mapping[str, NotFiniteError], used: int) -> list[str]:
    """A sentence on images that are left out, if there are any."""
    if not unusable:
        return []
    count, whose = len(unusable), agreeing(len(unusable), "its", "their")
    which = f"{count} of {count + used} images {agreeing(count, 'is', 'are')} left out"
    why = f"{whose} pose or camera is not finite, or zero"
    return [f"{which} ({name_some([*unusable], 3)}): {why}."]
