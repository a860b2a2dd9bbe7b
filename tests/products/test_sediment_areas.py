import numpy as np
import pyogrio
import pytest
import rasterio
import shapely
from affine import Affine

from sasmap.products.sediments import write_sediments

PLACE = Affine(0.5, 0, 500000, 0, -0.5, 4000000)


def written(tmp_path, label, rippled):
    confidence = np.where(label > 0, 0.5 + 0.1 * label, np.nan).astype(np.float32)
    crs = rasterio.crs.CRS.from_epsg(32617).to_wkt()
    names, codes = ("mud", "sand", "rock"), ("M", "", "R")
    write_sediments(
        tmp_path, label, confidence, rippled, (), names, codes, PLACE, crs, {}, tmp_path / "scratch"
    )
    meta, _, shapes, fields = pyogrio.raw.read(tmp_path / "sediment_areas.gpkg")
    return shapely.from_wkb(shapes), dict(zip(meta["fields"], fields, strict=True))


@pytest.fixture
def label():
    y, x = np.indices((1300, 200))
    made = np.where(x + 12 * np.sin(y / 17) > 90, 2, 1)
    made[(y > 700) & (x < 60 + 9 * np.sin(y / 11))] = 3
    made[np.hypot(y - 300, x - 150) < 25] = 3
    made[1200:, 150:] = 0
    return made.astype(np.uint8)


def test_areas_meet_exactly_and_tell_what_they_hold(tmp_path, label):
    rippled = (label == 2).astype(np.uint8)
    rippled[:400] = 0
    shapes, fields = written(tmp_path, label, rippled)
    assert shapely.is_valid(shapes).all()
    assert shapely.coverage_is_valid(shapes)
    seen = 0.25 * (label > 0).sum()
    assert shapely.area(shapes).sum() == pytest.approx(seen, rel=1e-3)
    assert shapely.union_all(shapes).area == pytest.approx(shapely.area(shapes).sum(), rel=1e-9)
    assert fields["area_m2"].sum() == pytest.approx(seen)
    for k, name, code in ((1, "mud", "M"), (2, "sand", ""), (3, "rock", "R")):
        mine = fields["class"] == k
        assert fields["area_m2"][mine].sum() == pytest.approx(0.25 * (label == k).sum())
        assert set(fields["name"][mine]) == {name}
        assert set(fields["code"][mine]) == {code}
        np.testing.assert_allclose(fields["confidence"][mine], 0.5 + 0.1 * k, rtol=1e-5)
    assert sorted(fields["rippled"][fields["class"] == 2]) == [False, True]
    wavy = fields["area_m2"][fields["rippled"]].sum()
    assert wavy == pytest.approx(0.25 * rippled.sum())
    assert not fields["rippled"][fields["class"] != 2].any()


def test_outlines_are_no_staircases(tmp_path, label):
    shapes, _ = written(tmp_path, label, np.zeros_like(label))
    length = shapely.length(shapes).sum()
    stairs = sum(
        0.5 * (np.diff(np.pad(label == k, 1).astype(int), axis=a) != 0).sum()
        for k in (1, 2, 3)
        for a in (0, 1)
    )
    assert length < 0.93 * stairs


def test_nothing_seen_has_no_areas(tmp_path):
    shapes, fields = written(tmp_path, np.zeros((64, 64), np.uint8), np.zeros((64, 64), np.uint8))
    assert len(shapes) == 0
    assert list(fields) == ["class", "name", "code", "area_m2", "confidence", "rippled"]
