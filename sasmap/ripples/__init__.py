"""Ripple frequency and height of one clip: numbers only, no files and no maps."""

from sasmap.ripples.clip import Clip
from sasmap.ripples.estimation import estimate
from sasmap.ripples.posterior import Posterior, Quality
from sasmap.ripples.priors import Prior
from sasmap.ripples.settings import RippleSettings

__all__ = ["Clip", "Posterior", "Prior", "Quality", "RippleSettings", "estimate"]
