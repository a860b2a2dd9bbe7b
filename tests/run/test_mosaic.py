import numpy as np
import pytest
import rasterio
from affine import Affine
from rio_cogeo import cog_validate

import sasmap
from sasmap.run.mosaic import GainRatio, solve_gains
from sasmap.run.pipeline import run_survey
from tests.helpers import small_survey, write_tile


def test_gains_that_all_pairs_agree_on_are_found():
    truth = np.array([0.0, 0.7, -0.4, 0.2])
    pairs = ((0, 1), (1, 2), (0, 2), (2, 3))
    ratios = [GainRatio(a, b, truth[b] - truth[a], 3.0) for a, b in pairs]
    np.testing.assert_allclose(solve_gains(ratios, 4), truth, atol=1e-9)


def test_passes_that_nothing_connects_keep_their_units():
    found = solve_gains([GainRatio(1, 2, 0.5, 1.0)], 4)
    np.testing.assert_allclose(found, [0, 0, 0.5, 0], atol=1e-9)
    np.testing.assert_allclose(solve_gains([], 2), [0, 0])


def test_a_pair_of_many_cells_weighs_more():
    ratios = [GainRatio(0, 1, 1.0, 9.0), GainRatio(0, 1, 0.0, 1.0)]
    assert solve_gains(ratios, 2)[1] == pytest.approx(0.9)


def test_the_mosaic_shows_what_was_looked_at_with_gains_made_to_meet(tmp_path):
    """A second pass, three times as bright, that shows more: over the first only where it ends."""
    path = small_survey(tmp_path, ripples=None, sediments={}, window=30)
    with rasterio.open(tmp_path / "tiles" / "a.tif") as source:
        first = source.read(1)
    second = 3 * np.random.default_rng(8).rayleigh(80.0, (40, 90)).astype("float32")
    corner = Affine(0.5, 0, 500010.0, 0, -0.5, 3300020.0)
    write_tile(tmp_path / "more" / "b.tif", second, corner, nodata=float("nan"))
    text = path.read_text()
    start = text.index("passes:")
    block = text[start : text.index("sediments:")].removeprefix("passes:\n")
    other = block.replace("name: one", "name: two").replace("tiles/*.tif", "more/*.tif")
    path.write_text(text.replace(block, block + other))
    outcome = run_survey(sasmap.load_survey(path))
    assert not [f for f in outcome.failures if f["stage"] == "mosaic.tif"]
    mosaic = tmp_path / "out" / "mosaic.tif"
    assert cog_validate(mosaic, strict=True)[0]
    with rasterio.open(mosaic) as source:
        values = source.read(1)
        assert source.crs.to_epsg() == 32617
        assert tuple(source.transform)[:6] == tuple(corner)[:6]
    np.testing.assert_array_equal(values[:40, :60], first)
    beyond = values[:40, 60:90]
    ratio = np.sqrt(np.mean(beyond**2) / np.mean(first**2))
    assert ratio == pytest.approx(1.0, abs=0.06)  # of speckle, not 3
    gain = beyond / second[:, 60:]
    np.testing.assert_allclose(gain, gain[0, 0], rtol=1e-5)
    assert np.isnan(values[40:]).all()


def test_the_mosaic_of_unchanged_pixels_is_kept(tmp_path):
    path = small_survey(tmp_path)
    run_survey(sasmap.load_survey(path))
    mosaic = tmp_path / "out" / "mosaic.tif"
    before = mosaic.stat().st_mtime_ns, mosaic.read_bytes()
    run_survey(sasmap.load_survey(path))
    assert (mosaic.stat().st_mtime_ns, mosaic.read_bytes()) == before
    mosaic.write_bytes(b"broken")
    run_survey(sasmap.load_survey(path))
    assert mosaic.read_bytes() == before[1]
