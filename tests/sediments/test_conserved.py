import numpy as np
import pytest

from sasmap.sediments.conserved import LAMBERT, POWERS, bed_of, power_of
from sasmap.sediments.floor import on_pixels
from sasmap.sediments.trends import BLOCK

ROWS, COLUMNS, LENGTH = 768, 1024, 48


def bed(power, seed, wide=True):
    """A bed in shadow whose amplitude goes with a power of the slope towards the sonar.

    One sediment; the last rows are flat where asked. Returns what `bed_of` finds.
    """
    rng = np.random.default_rng(seed)
    row, column = np.indices((ROWS, COLUMNS))
    cotangent = 3.0 + 10.0 * column / COLUMNS
    phase = 2 * np.pi * (column + 0.3 * row) / LENGTH
    slant = 1 / cotangent
    height = np.where(phase > 0, 0.35 * LENGTH / (2 * np.pi) * np.cos(phase), 0.0)
    # a ray that has met the floor farther in leaves shadow; else light goes with the slope to it
    reached = np.maximum.accumulate(height + np.cumsum(slant, axis=1), axis=1)
    sine = np.maximum(np.diff(reached, axis=1, prepend=reached[:, :1] - 0.1), 0.004)
    flat = row >= (ROWS // 2 if wide else ROWS)
    log = power * np.log(np.where(flat, slant, sine))
    gain = -0.3 * power * np.log(cotangent)
    amplitude = rng.rayleigh(size=row.shape) * np.exp(log + gain)
    # as the waves are taken off: mean amplitude 1 over a wavelength, by rows of equal range
    over = np.where(flat, 0.0, log - power * np.log(slant))
    pulse = np.exp(over)
    mean = np.stack([np.convolve(v, np.ones(LENGTH) / LENGTH, "same") for v in pulse])
    profile = np.where(flat, 0.0, over - np.log(mean))
    return bed_of(amplitude, cotangent, profile, ~flat), flat


def test_on_pixels_blocks_are_laid_and_the_last_goes_on():
    laid = on_pixels(np.array([[1.0, 2.0], [3.0, 4.0]]), (2 * BLOCK + 3, 2 * BLOCK))
    assert laid.shape == (2 * BLOCK + 3, 2 * BLOCK)
    assert (laid[:BLOCK, BLOCK:] == 2).all()
    assert (laid[-3:, :BLOCK] == 3).all()


def of_blocks(mask):
    return mask[BLOCK // 2 :: BLOCK, BLOCK // 2 :: BLOCK]


@pytest.mark.parametrize("power", [0.35, 0.5])
def test_the_power_of_a_law_is_found_and_makes_a_bed_as_bright_as_it_is_flat(power):
    found, flat = bed(power, 1)
    k = power_of([found])
    assert POWERS[k] < 0.75
    even = of_blocks(flat)
    rippled = ~even
    # blocks beside the images' edges and the bed's have averages of other floor too
    inner = np.zeros(even.shape, bool)
    inner[2:22, 6:-6] = inner[28:, 6:-6] = True

    def step(level):
        beds = np.median(np.where(inner & rippled, level, np.nan)[2:22, 6:-6], axis=0)
        flats = np.median(np.where(inner & even, level, np.nan)[28:, 6:-6], axis=0)
        return beds - flats

    before, after = step(found.level), step(found.level + found.change[k])
    assert np.abs(before).mean() > 0.2
    assert np.abs(after).mean() < 0.08


def test_lamberts_law_stays():
    assert power_of([bed(1.0, 2)[0]]) == LAMBERT


def test_a_bed_that_fills_the_survey_tells_no_power():
    assert power_of([bed(0.35, 3, wide=False)[0]]) == LAMBERT
