"""The methods that add points: their contract, their registry ``METHODS``, and the paper's.

``splatseed.upsample`` is what users call; ``add_points`` is its first step.
"""

from splatseed.methods.add_points import (
    DEFAULT_RATIO,
    add_points,
    check_seed,
    number_of_new,
    planned_size,
)
from splatseed.methods.contract import Made, Traits, Upsampler, traits_of
from splatseed.methods.registry import (
    BUILT_IN,
    METHODS,
    OWN_METHOD,
    SOURCE_CODES,
    Profile,
    absolute_place,
    chooses_number,
    configure,
    method_label,
    methods_for,
    resolve,
    source_code,
    source_name,
)

__all__ = [
    "BUILT_IN",
    "DEFAULT_RATIO",
    "METHODS",
    "OWN_METHOD",
    "SOURCE_CODES",
    "Made",
    "Profile",
    "Traits",
    "Upsampler",
    "absolute_place",
    "add_points",
    "check_seed",
    "chooses_number",
    "configure",
    "method_label",
    "methods_for",
    "number_of_new",
    "planned_size",
    "resolve",
    "source_code",
    "source_name",
    "traits_of",
]
