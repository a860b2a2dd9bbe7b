"""A run of a survey: plan, cost, tasks and their scheduling, finished work, both stages."""
