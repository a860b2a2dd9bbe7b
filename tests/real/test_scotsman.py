"""A recorded line; hand-computed geometry. Skips where the recording is not beside the checkout."""

from pathlib import Path

import numpy as np
import pyproj
import pytest
import yaml

import sasmap
from sasmap.run.pipeline import run_survey
from tests.helpers import SHARED

pytestmark = pytest.mark.skipif(
    not (SHARED / "scotsman").is_dir(), reason="the scotsman recording is not beside the checkout"
)
SURVEY = Path(__file__).resolve().parents[2] / "pipelines" / "scotsman" / "survey.yaml"


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    """The survey file beside the recording's own folder."""
    content = yaml.safe_load(SURVEY.read_text(encoding="utf-8"))
    line = content["passes"][0]
    line["tiles"] = [str(SHARED / "scotsman" / name) for name in line["tiles"]]
    line["navigation"] = str(SHARED / "scotsman" / line["navigation"])
    path = tmp_path_factory.mktemp("scotsman") / "survey.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return sasmap.load_survey(path)


def by_hand(x, y):
    """Ground range and altitude by trying a point every centimetre of the track."""
    rows = np.genfromtxt(SHARED / "scotsman" / "navigation.csv", delimiter=",", names=True)
    utm = pyproj.Transformer.from_crs(4326, 32619, always_xy=True)
    east, north = utm.transform(rows["longitude"], rows["latitude"])
    fine = np.linspace(0, len(rows) - 1, 20 * len(rows))
    ping = np.arange(len(rows))
    track = [np.interp(fine, ping, v) for v in (east, north, rows["altitude"])]
    away = np.hypot(track[0] - x, track[1] - y)
    return away.min(), track[2][away.argmin()]


def test_range_and_altitude_of_ten_pixels(survey):
    array = sasmap.open_pass(survey, "line")
    rng = np.random.default_rng(8)
    geometry = xr_values(array, ("ground_range", "altitude"))
    values = array.values
    rows, columns = np.nonzero(np.isfinite(values) & (values > 0))
    for k in rng.choice(rows.size, 10, replace=False):
        i, j = rows[k], columns[k]
        distance, altitude = by_hand(float(array.x[j]), float(array.y[i]))
        assert abs(geometry["ground_range"][i, j] - distance) < 0.1
        assert abs(geometry["altitude"][i, j] - altitude) < 0.1


def xr_values(array, names):
    return {name: array.coords[name].values for name in names}


def test_altitude_falls_along_the_line_and_sides_look_apart(survey):
    array = sasmap.open_pass(survey, "line").compute()
    seen = np.isfinite(array.values)
    altitude = array.altitude.values[seen]
    assert 10.5 < altitude.max() < 11.5
    assert 2.5 < altitude.min() < 3.5
    look = array.look_azimuth.values[seen]
    port = (look > 180) & (look < 300)
    assert 0.3 < port.mean() < 0.7
    assert (np.abs((look[port] - 238 + 180) % 360 - 180) < 15).all()
    assert (np.abs((look[~port] - 58 + 180) % 360 - 180) < 15).all()


def test_the_smooth_floor_has_no_ripples(survey, tmp_path):
    outcome = run_survey(survey, output=tmp_path)
    assert outcome.failures == []
    counts = outcome.counts()
    assert counts["no ripples"] >= 30
    assert counts.get("good", 0) == counts.get("not converged", 0) == 0
