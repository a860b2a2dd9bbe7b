"""A fit's error where crests bend too slightly for a phase field to follow them."""

from tests.ripples.engine import fitted_cell


def test_slight_bends_widen_the_error_of_the_wave_number():
    bends = {"wander": 0.5, "wander_length": 6.0}
    seeds = (0, 1, 3)  # a phase field follows cell 2
    # seen square-on, the displacement of the pulse counts as well
    slight = [fitted_cell(seed, 10.0, **bends)[2] for seed in seeds]
    straight = [fitted_cell(seed, 10.0)[2] for seed in seeds]
    assert all(fit.phase.rigid for fit in straight + slight)
    for one, other in zip(straight, slight, strict=True):
        assert other.tilt > 1.5 * one.tilt
        assert other.across[1] > 1.5 * one.across[1]
