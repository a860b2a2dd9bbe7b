"""Where pixels are and what saw them: tiles, navigation, the cell grid."""

from sasmap.survey.opening import open_pass, open_survey

__all__ = ["open_pass", "open_survey"]
