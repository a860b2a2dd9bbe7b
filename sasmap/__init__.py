"""Sand-ripple geometry and sediment maps, with error bars, from synthetic aperture sonar tiles."""

from sasmap import ripples, sediments
from sasmap.io.results import open_run
from sasmap.settings.survey import load_survey
from sasmap.survey import open_pass
from sasmap.version import VERSION

__version__ = VERSION

__all__ = ["load_survey", "open_pass", "open_run", "ripples", "sediments"]
