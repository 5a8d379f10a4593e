from .maps import (
    StereoMap as StereoMap,
    StereoResult as StereoResult,
    StereoSettings as StereoSettings,
)
from .pipeline import stereo_depths as stereo_depths
