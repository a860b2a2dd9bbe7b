"""Raw recordings to ground-range tiles, navigation and a survey file (``sasmap tiles``)."""

from sasmap.survey.raw.tiles import make_tiles

__all__ = ["make_tiles"]
