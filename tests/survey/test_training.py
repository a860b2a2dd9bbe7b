import json

import numpy as np
import pyogrio
import pyproj
import pytest
import shapely

import sasmap
from sasmap.errors import InputError
from sasmap.survey.cells import Cell
from sasmap.survey.opening import open_survey
from sasmap.survey.training import cells_shown, marked, read_training
from tests.helpers import UTM, small_survey

# of the small survey's tile, 500010 to 500040 east and 3300000 to 3300020 north
WEST = shapely.box(500012, 3300002, 500018, 3300018)
EAST = shapely.box(500030, 3300001, 500038, 3300009)


def geojson(path, *shapes, crs=None):
    """Write shapes as GeoJSON: in WGS 84, or in the CRS named."""
    content = {"type": "FeatureCollection", "features": []}
    if crs is not None:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    to_wgs = pyproj.Transformer.from_crs(UTM, "OGC:CRS84", always_xy=True)
    for shape in shapes:
        if crs is None:
            shape = shapely.transform(shape, to_wgs.transform, interleaved=False)
        geometry = shapely.geometry.mapping(shape)
        content["features"].append({"type": "Feature", "properties": {}, "geometry": geometry})
    path.write_text(json.dumps(content))


def geopackage(path, *shapes):
    wkb = shapely.to_wkb(list(shapes))
    pyogrio.raw.write(path, wkb, [], [], driver="GPKG", geometry_type="Polygon", crs=UTM)


def survey_with(folder, west="west.geojson", east="east.gpkg"):
    classes = [{"name": "sand", "training": west}, {"name": "mud", "training": east}]
    path = small_survey(folder, sediments={"classes": classes}, ripples=None)
    survey = sasmap.load_survey(path)
    return survey, open_survey(survey).grid


def test_polygons_of_any_format_and_crs_lie_where_they_should(tmp_path):
    geojson(tmp_path / "west.geojson", WEST)
    geopackage(tmp_path / "east.gpkg", EAST)
    survey, grid = survey_with(tmp_path)
    training = read_training(survey, grid)
    assert [t.name for t in training] == ["sand", "mud"]
    assert training[0].area.area == pytest.approx(WEST.area, rel=1e-3)
    assert cells_shown(training, grid) == [(0, 0), (1, 0), (1, 2)]
    marks = marked(training, grid, Cell(1, 0), 20)
    # half-metre pixels; the cell's top edge is at 3300010, the polygon ends at 3300002
    expected = np.zeros((20, 20))
    expected[:16, 4:16] = 1
    np.testing.assert_array_equal(marks, expected)
    assert (marked(training, grid, Cell(1, 2), 20) == 2).sum() == 16 * 16
    assert not marked(training, grid, Cell(0, 1), 20).any()


def test_older_geojson_names_its_crs(tmp_path):
    geojson(tmp_path / "west.geojson", WEST, crs="urn:ogc:def:crs:EPSG::32617")
    geojson(tmp_path / "east.gpkg", EAST, crs=UTM)  # told by what it holds, not by its name
    survey, grid = survey_with(tmp_path)
    sand, mud = read_training(survey, grid)
    assert sand.area.equals(WEST)
    assert mud.area.equals(EAST)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("{", "expected a GeoJSON or GeoPackage of polygons"),
        ("[]", "expected a GeoJSON or GeoPackage of polygons"),
        ('{"type": "Point", "coordinates": [1, 2]}', "holds no polygons"),
        ('{"type": "Polygon", "coordinates": [[[-80, 29], [-79, 29], [-79, 30], [-80, 29]]]}',
         "no polygon"),
        ('{"type": "Polygon", "coordinates": "x"}', "expected a GeoJSON or GeoPackage"),
        ("<OGRVRTDataSource><SrcDataSource>/vsicurl/http://x</SrcDataSource></OGRVRTDataSource>",
         "expected a GeoJSON or GeoPackage"),
        ("SQLite format 3\0 and nothing", "expected a GeoJSON or GeoPackage"),
    ],
)  # fmt: skip
def test_other_files_are_refused_in_one_line(tmp_path, content, expected):
    (tmp_path / "west.geojson").write_text(content)
    geojson(tmp_path / "east.gpkg", EAST)
    survey, grid = survey_with(tmp_path)
    with pytest.raises(InputError) as caught:
        read_training(survey, grid)
    (fault,) = caught.value.faults
    assert "west.geojson" in fault
    assert expected in fault
    assert "\n" not in fault


def test_missing_files_and_overlaps_are_refused(tmp_path):
    geojson(tmp_path / "west.geojson", WEST, EAST)
    survey, grid = survey_with(tmp_path)
    with pytest.raises(InputError, match=r"east\.gpkg: cannot be read: no such file"):
        read_training(survey, grid)
    geopackage(tmp_path / "east.gpkg", EAST)
    with pytest.raises(InputError, match="polygons of 'mud' overlap those of 'sand'"):
        read_training(survey, grid)
