"""survey.yaml as a checked, frozen model, and the reference of its keys."""
