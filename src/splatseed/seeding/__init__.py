"""Seeding: as many seeds as asked for, where the photographs need them.

``cover`` puts one wherever no point is seen, ``budget`` chooses which are kept. Import from the
modules, as in ``splatseed.seeding.cover``, so that none is loaded before it is needed. The methods
that look at photographs join ``METHODS`` here.
"""

from splatseed.upsample.registry import add_built_in

add_built_in(
    {
        "stereo": "splatseed.seeding.photographs:Stereo",
        "cover": "splatseed.seeding.photographs:Cover",
        "auto": "splatseed.seeding.photographs:Auto",
        "cloud": "splatseed.seeding.clouds.method:Cloud",
    }
)
