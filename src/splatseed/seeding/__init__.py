"""Seeding: as many seeds as asked for, where the photographs need them.

Import from the modules, so that none is loaded before it is needed. The methods that look at
photographs join ``METHODS`` here.
"""

from splatseed.upsample import add_built_in

add_built_in(
    {
        "stereo": "splatseed.seeding.photographs:Stereo",
        "cover": "splatseed.seeding.photographs:Cover",
        "auto": "splatseed.seeding.photographs:Auto",
        "cloud": "splatseed.seeding.clouds.method:Cloud",
    }
)
