"""Sediments by the statistics of their amplitude."""

from sasmap.numerics.looks import effective_samples
from sasmap.sediments.distributions import generalized_k, k_distribution
from sasmap.sediments.fitting import (
    Choice,
    Law,
    choose,
    fit,
    grey_histogram,
    histogram,
)

__all__ = [
    "Choice",
    "Law",
    "choose",
    "effective_samples",
    "fit",
    "generalized_k",
    "grey_histogram",
    "histogram",
    "k_distribution",
]
