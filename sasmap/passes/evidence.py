"""Evidence of the cells of a survey as a function of the shared parameters."""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from sasmap.arrays import FloatArray
from sasmap.passes.heights import with_scatter, without_scatter
from sasmap.passes.information import Information, products
from sasmap.passes.looks import (
    LAW_MEAN,
    LAW_VARIANCE,
    LEAST_LEVEL,
    LOG_HEIGHT,
    LawLikelihood,
    Looks,
    Shared,
    evidence_of_law,
    law_factor,
)

# Largest spread over the prior standard deviation of the law.
MOST_SPREAD = 0.95
# Median of the prior of the scatter between passes, of log f, log A_H and azimuth (degrees), and
# the scatter of the quantities that differ where passes disagree (choices: small compared with the
# error of a look, and wide enough to be harmless).
SCATTER, ODD_SCATTER = np.array([3e-4, 0.01, 0.1]), np.array([0.15, 0.4, 10.0])
# Logit of the share of the law's variance from look to look within a cell: about one in five.
SHARE_LOGIT = -1.4
# Most components kept in a product of looks, to bound time and memory.
MOST_KEPT = 6
# Most results that are cached: bounds memory, but exceeds the steps of a numerical derivative.
REMEMBERED = 512


class CellEvidence:
    """Evidence of cells as a function of the shared parameters.

    Parameters
    ----------
    looks : Looks
        Sorted by cell.
    """

    def __init__(self, looks: Looks) -> None:
        _, cell, count = np.unique(looks.cell, return_inverse=True, return_counts=True)
        several = count[cell] > 1
        self.size = count.size
        self.single, self.multiple = np.flatnonzero(count == 1), np.flatnonzero(count > 1)
        self.law = None
        if looks.law is not None and self.single.size:
            self.law = LawLikelihood(*(v[~several] for v in looks.law))
        self.looks = looks.some(np.flatnonzero(several))
        self.ends = np.cumsum(count[count > 1])
        self.sediment = looks.sediment[np.cumsum(count) - 1]
        # passes that differ do not inform the shared parameters: take the evidence under any law
        nothing = np.zeros(int(looks.swath.max()) + 1)
        whole = MOST_SPREAD * np.sqrt(LAW_VARIANCE)
        any_law = Shared(
            LAW_MEAN, whole, np.zeros(2), nothing, ODD_SCATTER, expit(SHARE_LOGIT), 1.0
        )
        f_alone, _, azimuth_alone = np.where(np.eye(3), ODD_SCATTER, SCATTER)
        self.odd = self._together(any_law, ODD_SCATTER, f_alone, azimuth_alone)
        self._known: dict[bytes, FloatArray] = {}

    def evidence(self, shared: Shared) -> FloatArray:
        """Log evidence of each cell (cells,): its looks have the same f, A_H, azimuth and law.

        The last results are cached, as numerical derivatives change one population at a time.

        The priors of f, A_H and azimuth are flat: ripples have similar steepness all over a survey,
        so the steepness of many cells is not independent evidence about the law. The passes of a
        cell may differ, with the probability `Shared.odd`.
        """
        key = np.concatenate([np.ravel(v) for v in shared]).tobytes()
        if key in self._known:
            return self._known[key]
        every = np.zeros(self.size)
        if self.law is not None:
            every[self.single] = evidence_of_law(self.law, shared)
        if self.multiple.size:
            other_height = shared.scatter.copy()
            other_height[LOG_HEIGHT] = ODD_SCATTER[LOG_HEIGHT]
            honest, unlike = self._together(shared, shared.scatter, other_height)
            kinds = [unlike, *self.odd]
            odd = np.logaddexp.reduce(kinds) + np.log(shared.odd / len(kinds))
            every[self.multiple] = np.logaddexp(honest + np.log1p(-shared.odd), odd)
        if len(self._known) == REMEMBERED:
            del self._known[next(iter(self._known))]
        self._known[key] = every
        return every

    def _together(self, shared: Shared, *scatters: FloatArray) -> list[FloatArray]:
        """Log evidence of cells with several looks, for each of several scatters between passes."""
        if not self.multiple.size:
            return [np.zeros(0) for _ in scatters]
        there = without_scatter(self.looks, shared)
        prior = law_factor(shared, self.looks.with_law)
        found = []
        for scatter in scatters:
            every = np.broadcast_to(scatter, (self.looks.cell.size, 3))
            factor = with_scatter(there, shared, every)
            found.append(np.maximum(products(factor, self.ends, prior, MOST_KEPT), LEAST_LEVEL))
        return found


def with_prior(total: Information, prior: Information) -> Information:
    """Multiply looks by a prior of one component."""
    return Information(*(a + b for a, b in zip(total, prior, strict=True)))
