"""A run of a survey: plan, cost, tasks and their scheduling, stored results, both stages."""
