"""Tiles, navigation and the cell grid: where pixels lie and how the sonar saw them."""

from sasmap.survey.opening import open_pass, open_survey

__all__ = ["open_pass", "open_survey"]
