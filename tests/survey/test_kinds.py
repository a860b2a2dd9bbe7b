"""Surveys as surveyors have them: what is odd is read rightly, named, or refused with a remedy.

Each entry stands for a kind. Answers: ``same``, the clean survey's pixels and geometry without a
word; ``name``, the same with a warning that holds the words; ``doubt``, a warning, numbers as they
are; ``refuse``, one line that holds the words.
"""

import io

import numpy as np
import pyproj
import pytest
import rasterio
import yaml
from affine import Affine
from rasterio.enums import ColorInterp
from scipy.ndimage import gaussian_filter, zoom

import sasmap
from sasmap.errors import InputError
from sasmap.survey.opening import open_survey
from tests.helpers import UTM

SIDE, PIXEL = 320, 0.05
PLACE = Affine(PIXEL, 0, 500005.0, 0, -PIXEL, 3300016.0)
NORTH = np.arange(3299995.0, 3300022.0, 0.5)
RNG = np.random.default_rng(7)
SPECKLE = np.minimum(RNG.rayleigh(40.0, (SIDE, SIDE)), 255).astype("uint8")
LEVEL = np.maximum(SPECKLE, 1).astype(float)
COMPLEX = RNG.normal(size=(2, SIDE, SIDE))


def track(x=500000.0, north=NORTH, altitude=5.0):
    return np.column_stack(np.broadcast_arrays(x, north, altitude)).astype(float)


def rows_of(pings, mark=",", head="x,y,altitude", write=repr):
    lines = [mark.join(write(float(v)) for v in ping) for ping in pings]
    return "\n".join([head.replace(",", mark), *lines]) + "\n"


class Folder:
    """A survey in the making: a tile, its navigation, the survey file's keys."""

    def __init__(self, path):
        self.path = path
        self.keys, self.survey = {}, {}
        (path / "t").mkdir()

    def tile(self, values=SPECKLE, name="a.tif", transform=PLACE, crs=UTM, **options):
        values = np.asarray(values)
        values = values if values.ndim == 3 else values[None]
        interpretation = options.pop("colorinterp", None)
        with rasterio.open(
            self.path / "t" / name, "w", driver="GTiff", count=values.shape[0], crs=crs,
            height=values.shape[1], width=values.shape[2], dtype=values.dtype,
            transform=transform, **options,
        ) as target:  # fmt: skip
            if interpretation:
                target.colorinterp = interpretation
            target.write(values)

    def text(self, content, name="nav.csv"):
        raw = content if isinstance(content, bytes) else content.encode()
        (self.path / name).write_bytes(raw)

    def pings(self, pings):
        self.text(rows_of(pings))

    def open(self):
        if not list((self.path / "t").glob("*.tif")):
            self.tile()
        if not (self.path / "nav.csv").exists():
            self.pings(track())
        one = {"name": "one", "tiles": ["t/*.tif"], "navigation": "nav.csv", "side": "starboard"}
        content = {"name": "kind", "window": 320, "passes": [one | self.keys], "ripples": {}}
        path = self.path / "survey.yaml"
        path.write_text(yaml.safe_dump(content | self.survey))
        return open_survey(sasmap.load_survey(path))


def changed(row, **values):
    """Pings with one changed; row as a person counts them, the header being 1."""
    pings = track()
    for key, value in values.items():
        pings[row - 2, ("x", "y", "altitude").index(key)] = value
    return pings


def jpeg(values, quality=85):
    image = pytest.importorskip("PIL.Image")
    stream = io.BytesIO()
    image.fromarray(values).save(stream, "jpeg", quality=quality)
    return np.array(image.open(stream))


def decibels(offset=0.0, scale=1.0):
    return (scale * 20 * np.log10(LEVEL) + offset).astype("float32")


def filled(value, width=40, dtype="float32"):
    values = SPECKLE.astype(dtype)
    values[:width] = value
    values[:, -width:] = value
    return values


def k_speckle(shape):
    texture = RNG.gamma(shape, 1 / shape, (SIDE, SIDE))
    return (40 * np.sqrt(texture) * np.hypot(*COMPLEX)).astype("float32")


WAVY = LEVEL * (1 + 0.4 * np.sin(np.arange(SIDE) / 6))


def powered(gamma, level=LEVEL):
    return np.minimum(255 * (level / 255) ** gamma + 0.5, 255).astype("uint8")


NADIR = PLACE @ Affine.translation(-100, 0)


def water(values, fill=False):
    """The first five metres of a tile that begins below the sonar show water, or nothing."""
    values = values.copy()
    values[:, :100] = 0 if fill else RNG.rayleigh(2.0, (SIDE, 100)).astype(values.dtype)
    return values


def column(values, altitude=5.0, **keys):
    def write(folder):
        folder.tile(values, transform=NADIR, nodata=0)
        folder.pings(track(altitude=altitude))
        folder.keys.update(keys)

    return write


def bordered(noise):
    """Speckle with a corner and a side of something nearly black."""
    row, column = np.mgrid[:SIDE, :SIDE]
    return np.where((row + column < 200) | (column > 290), noise, SPECKLE).astype("float32")


def striped(first):
    """Shadows 24 pixels wide along the tile's side, the first one cut by its edge."""
    dark = (np.arange(SIDE) + first) % 60 < 24
    return np.where(dark, RNG.rayleigh(1.5, (SIDE, SIDE)), SPECKLE).astype("uint8")


def palette(folder):
    folder.tile(photometric="palette")
    with rasterio.open(folder.path / "t" / "a.tif", "r+") as target:
        target.write_colormap(1, {k: (255 - k, k // 2, 40, 255) for k in range(256)})


def degrees(folder):
    longitude, latitude = -81.0, 29.83
    folder.tile(transform=Affine(5e-7, 0, longitude, 0, -5e-7, latitude), crs="EPSG:4326")
    folder.survey["crs"] = UTM
    north = np.linspace(latitude - 3e-4, latitude + 1e-4, 90)
    folder.text(rows_of(track(longitude - 6e-5, north), head="longitude,latitude,altitude"))


def beside(ending, content):
    def write(folder):
        folder.tile()
        (folder.path / "t" / f"a{ending}").write_text(content)

    return write


def two_tiles(factor):
    def write(folder):
        folder.tile(SPECKLE[:, :160])
        folder.tile(
            (SPECKLE[:, 160:] * factor).astype("uint8"), "b.tif", PLACE @ Affine.translation(160, 0)
        )

    return write


def told(kind, values):
    def write(folder):
        folder.keys["amplitude"] = kind
        folder.tile(values)

    return write


def tile(values, **options):
    return lambda folder: folder.tile(values, **options)


def pings(rows):
    return lambda folder: folder.pings(rows)


def text(content, **keys):
    def write(folder):
        folder.text(content)
        folder.keys.update(keys)

    return write


def rounded(folder):
    back = pyproj.Transformer.from_crs(UTM, 4326, always_xy=True)
    x, y, altitude = track().T
    longitude, latitude = back.transform(x, y)
    rows = np.column_stack([np.round(longitude, 5), np.round(latitude, 5), altitude])
    folder.text(rows_of(rows, head="longitude,latitude,altitude"))


def named(name, pattern):
    def write(folder):
        folder.tile()
        (folder.path / "t" / "a.tif").rename(folder.path / "t" / name)
        folder.tile(name="b.tif")
        folder.keys["tiles"] = [pattern]
        folder.pings(track())

    return write


def picture(folder):
    image = pytest.importorskip("PIL.Image")
    image.fromarray(SPECKLE).save(folder.path / "t" / "a.png")
    folder.keys["tiles"] = ["t/*.png"]
    folder.tile(name="b.tif")


def west(folder):
    longitude, latitude = -81.0, np.linspace(29.8297, 29.8301, 90)
    folder.text(rows_of(track(-longitude, latitude), head="longitude,latitude,altitude"))


SLOW = "\n".join(
    f"{x},{y},{z if k % 6 == 0 else ''}" for k, (x, y, z) in enumerate(track().tolist())
)
LATE = np.arange(NORTH.size)[:, None] >= 30
EAST, ALTITUDE = np.arange(3) == 0, np.arange(3) == 2
FAR_LINE = track(502000.0, NORTH[::-1])
KINDS = [
    # what a tile's numbers are
    ("dB scaled to 8 bits", "name", ("a.tif", "decibels"), tile((decibels() * 5).astype("uint8"))),
    ("dB with a large offset", "refuse", ("a.tif", "amplitude: db"), tile(decibels(90))),
    ("dB below zero", "refuse", ("a.tif", "amplitude: db"), tile(decibels(-90))),
    ("log display", "name", ("a.tif", "A_H"), tile((40 * np.log1p(LEVEL / 20)).astype("uint8"))),
    ("equalised", "name", ("a.tif", "equalised"),
     tile((SPECKLE.ravel().argsort().argsort().reshape(SIDE, SIDE) >> 9).astype("uint8"))),
    ("four looks averaged", "name", ("a.tif", "averaging"),
     tile(np.sqrt(RNG.gamma(4, 200, (SIDE, SIDE))).astype("float32"))),
    ("averaged intensity", "name", ("a.tif", "amplitude: intensity"),
     tile(RNG.gamma(4, 200, (SIDE, SIDE)).astype("float32"))),
    ("interpolated", "name", ("a.tif", "interpolation"),
     tile(zoom(LEVEL[:246, :246], 1.3, order=1).astype("float32"))),
    ("offset added", "name", ("a.tif", "contrast"), tile((LEVEL + 60).astype("float32"))),
    ("black level subtracted", "name", ("a.tif", "black level"),
     tile(np.maximum(SPECKLE.astype(int) - 20, 0).astype("uint8"))),
    ("mean subtracted", "refuse", ("a.tif", "negative"), tile((LEVEL - 50).astype("float32"))),
    ("saturated", "name", ("a.tif", "saturated"), tile(np.minimum(LEVEL * 3, 255).astype("uint8"))),
    ("few grey levels", "name", ("a.tif", "grey levels"), tile(SPECKLE // 32 * 32)),
    ("JPEG written again as TIFF", "name", ("a.tif", "JPEG"), lambda f: f.tile(jpeg(SPECKLE))),
    ("JPEG, cut", "name", ("a.tif", "JPEG"), lambda f: f.tile(jpeg(SPECKLE)[5:, 3:])),
    ("palette", "refuse", ("a.tif", "palette"), palette),
    ("coloured picture", "refuse", ("a.tif", "colour image"),
     tile(np.stack([SPECKLE, SPECKLE // 2, SPECKLE // 4]), photometric="rgb")),
    ("complex", "refuse", ("a.tif", "magnitude"), tile((LEVEL * (1 + 1j)).astype("complex64"))),
    ("two bands", "refuse", ("a.tif", "-b 1"), tile(np.stack([SPECKLE, SPECKLE]))),
    ("intensity told, amplitude given", "name", ("a.tif", "amplitude: linear"),
     told("intensity", SPECKLE)),
    ("dB told, amplitude given", "refuse", ("a.tif", "amplitude: linear"), told("db", SPECKLE)),
    ("dB told, intensity given", "refuse", ("a.tif", "amplitude:"),
     told("db", (LEVEL**2).astype("float32"))),
    ("intensity told, dB given", "refuse", ("a.tif", "amplitude: db"),
     told("intensity", decibels(50))),
    # honest numbers
    ("K-distributed, shape 1", "same", (), tile(k_speckle(1.0))),
    ("K-distributed, shape 3", "same", (), tile(k_speckle(3.0))),
    ("dark floor in 8 bits", "same", (), tile(np.rint(np.hypot(*COMPLEX) * 4).astype("uint8"))),
    ("speckle over four pixels", "same", (),
     tile(np.hypot(*gaussian_filter(COMPLEX, (0, 1.5, 1.5))).astype("float32"))),
    ("water column and noise", "same", (), column(water(SPECKLE), range="slant")),
    ("16 bits", "same", (), tile((LEVEL * 200).astype("uint16"))),
    ("grey with alpha", "same", (),
     tile(np.stack([SPECKLE, np.full_like(SPECKLE, 255)]),
          colorinterp=(ColorInterp.gray, ColorInterp.alpha))),
    ("grey as RGB", "same", (), tile(np.stack([SPECKLE] * 3), photometric="rgb")),
    # nearly amplitude: only the shape of the logarithm tells
    ("gamma 1.2", "name", ("a.tif", "gamma of about 1.2"), tile(powered(1.2))),
    ("gamma 1.5", "name", ("a.tif", "gamma of about 1.5"), tile(powered(1.5))),
    ("gamma 0.85, ripples", "name", ("a.tif", "compressed"), tile(powered(0.85, WAVY))),
    ("K-distributed, shape 2, ripples", "same", (),
     tile(k_speckle(2.0) * (1 + 0.4 * np.sin(np.arange(SIDE) / 6)).astype("float32"))),
    ("LERC, lossy", "name", ("a.tif", "LERC"),
     tile(SPECKLE.astype("float32"), compress="lerc", max_z_error=8)),
    ("LERC, next to lossless", "same", (),
     tile(SPECKLE.astype("float32"), compress="lerc", max_z_error=0.01)),
    # fill
    ("fill of -9999", "name", ("a.tif", "-9999", "-a_nodata"), tile(filled(-9999.0))),
    ("white fill", "name", ("a.tif", "255"), tile(filled(255, dtype="uint8"))),
    ("thin black frame", "name", ("a.tif", "exactly 0"), tile(filled(0, 9, "uint8"))),
    ("border of noise", "name", ("a.tif", "nearblack"),
     tile(bordered(RNG.integers(0, 4, (SIDE, SIDE))))),
    ("border of tiny numbers", "name", ("a.tif", "nearblack"),
     tile(bordered(RNG.uniform(0, 1e-3, (SIDE, SIDE))))),
    ("shadows along the edge", "same", (), tile(striped(0))),
    ("shadows of exactly zero along the edge", "same", (), tile(striped(6) // 8 * 8)),
    # range and the water column
    ("slant told as ground", "name", ("nav.csv", "dark up to 5", "range: slant"),
     column(water(SPECKLE))),
    ("slant without water told as ground", "name", ("nav.csv", "range: slant"),
     column(water(SPECKLE, fill=True))),
    ("ground told as slant", "name", ("nav.csv", "range: ground"), column(SPECKLE, range="slant")),
    ("slant, altitude in feet", "doubt", ("nav.csv", "first echo is at 5", "feet"),
     column(water(np.hstack([SPECKLE, SPECKLE])), 16.4, range="slant")),
    ("slant, altitude in fathoms", "doubt", ("nav.csv", "first echo is at 5", "fathoms"),
     column(water(SPECKLE), 2.73, range="slant")),
    # names of files
    ("ending in upper case", "refuse", ("upper and lower case", "a.TIF"),
     named("a.TIF", "t/a*.tif")),
    ("folders parted as on Windows", "refuse", ("parted by /",), named("a.tif", "t\\*.tif")),
    ("a folder for its tiles", "refuse", ("expected files, such as t/*.tif",), named("a.tif", "t")),
    ("no such folder", "refuse", ("there is no folder",), named("a.tif", "tiles/*.tif")),
    ("PNG", "refuse", ("gdal_translate a.png a.tif",), picture),
    # place
    ("geographic", "refuse", ("a.tif", "crs: EPSG:"),
     tile(SPECKLE, transform=Affine(5e-7, 0, -81, 0, -5e-7, 29.8), crs="EPSG:4326")),
    ("geographic, products placed", "same", (), degrees),
    ("3-D geographic", "refuse", ("a.tif", "3-D"),
     tile(SPECKLE, transform=Affine(5e-7, 0, -81, 0, -5e-7, 29.8), crs="EPSG:4979")),
    ("with heights", "refuse", ("a.tif", "3-D", "EPSG:32617"),
     tile(SPECKLE, crs="EPSG:32617+5773")),
    ("overviews beside", "name", (".ovr",), beside(".tif.ovr", "x")),
    ("another world file beside", "name", (".tfw",), beside(".tfw", "1\n0\n0\n-1\n7\n9\n")),
    ("statistics beside", "same", (),
     beside(".tif.aux.xml", "<PAMDataset><Metadata/></PAMDataset>")),
    # gain
    ("gain changes at a seam", "name", ("b.tif", "dB"), two_tiles(0.5)),
    ("one gain at a seam", "same", (), two_tiles(1)),
    # navigation
    ("UTF-16 with tabs", "same", (), text(rows_of(track(), "\t").encode("utf-16"))),
    ("titles above the header", "same", (), text("Line 7\nEiva export\n\n" + rows_of(track()))),
    ("separated by spaces", "same", (), text(rows_of(track(), " ", head="x,y,altitude (m)"))),
    ("trailing marks", "same", (), text(rows_of(track(), ";").replace("\n", ";\n"))),
    ("thousands", "same", (), text(rows_of(track(), write=lambda v: f'"{v:,.3f}"'))),
    ("old Mac lines", "same", (), text(rows_of(track()).replace("\n", "\r"))),
    ("western code page", "same", (),
     text(rows_of(track(), head="x,y,altitude,größe".replace(",größe", "")).encode("cp1252")
          + "# größe\n".encode("cp1252"))),
    ("altitude in feet", "refuse", ("nav.csv", "row 1", "ft"),
     text(rows_of(track(), head="x,y,altitude (ft)"))),
    ("altitude in centimetres", "refuse", ("nav.csv", "altitude"), pings(track(altitude=500.0))),
    ("no altitude for some pings", "name", ("nav.csv", "row", "7"), pings(changed(7, altitude=0))),
    ("999 for no altitude", "name", ("nav.csv", "9"), pings(changed(9, altitude=999))),
    ("altitude that falls for good", "name", ("nav.csv", "row 32"),
     pings(np.where(np.arange(54)[:, None] < 30, track(), track(altitude=30.0)))),
    ("no altitude at all", "refuse", ("nav.csv", "row 2"), pings(track(altitude=-1.0))),
    ("first position wrong", "name", ("nav.csv", "row 2"), pings(changed(2, x=499900.0))),
    ("last position zero", "name", ("nav.csv", "row 55"), pings(changed(55, x=0.0, y=0.0))),
    ("shuffled", "refuse", ("nav.csv", "order"), pings(RNG.permutation(track()))),
    ("pasted twice", "name", ("nav.csv", "repeats row 2"), pings(np.vstack([track(), track()]))),
    ("parallel lines one way", "refuse", ("a.tif", "rows 2 to 55", "rows 56 to 109"),
     pings(np.vstack([track(), track(499994.0)]))),
    ("another line far away", "name", ("nav.csv", "2 lines", "rows 2 to 55"),
     pings(np.vstack([track(), FAR_LINE]))),
    ("named with its unit", "same", (),
     text(rows_of(track(), head="x,y,Alt (m)"), columns={"altitude": "Alt (m)"})),
    ("one of two altitudes named", "same", (),
     text(rows_of(np.column_stack([track(), track()[:, 2] * 3.28]), head="x,y,alt (m),alt (ft)"),
          columns={"altitude": "alt (m)"})),
    ("altitude that steps by a third", "name", ("nav.csv", "row 32"),
     pings(np.where(LATE & ALTITUDE, 6.7, track()))),
    ("track that steps aside", "name", ("nav.csv", "row 32", "1.3 m across"),
     pings(track() + 1.3 * (LATE & EAST))),
    ("rounded to five digits", "name", ("nav.csv", "latitude", "rounded"), rounded),
    ("every fix held for two pings", "same", (), pings(np.repeat(track(), 2, axis=0))),
    ("units in a row of their own", "same", (),
     text(rows_of(track(), head="x,y,altitude\nm,m,m"))),
    ("altitude in feet by its name", "refuse", ("nav.csv", "row 1", "'ft'"),
     text(rows_of(track(), head="x,y,altitude_ft"))),
    ("feet in a row of their own", "refuse", ("nav.csv", "'ft'"),
     text(rows_of(track(), head="x,y,altitude\nm,m,ft"))),
    ("unit with a remark", "same", (),
     text(rows_of(track(), head="x,y,altitude (metres above seabed)"))),
    ("thousands with blanks", "same", (),
     text(rows_of(track(), ";", write=lambda v: f"{v:,.3f}".replace(",", "\u00a0")))),
    ("thousands with apostrophes", "same", (),
     text(rows_of(track(), ";", write=lambda v: f"{v:,.3f}".replace(",", "'")))),
    ("altitude in feet, not said", "doubt", ("nav.csv", "altitude"), pings(track(altitude=16.4))),
    ("first half last", "refuse", ("rows 2 to",), pings(np.roll(track(), 27, axis=0))),
    ("spaces and decimal commas", "same", (),
     text(rows_of(track(), " ", write=lambda v: f"{v:.3f}".replace(".", ",")))),
    ("comments among the rows", "same", (),
     text(rows_of(track()).replace("\n500000.0,3299996.0", "\n# event 7\n500000.0,3299996.0"))),
    ("world file and no CRS", "refuse", ("a.tfw", "-a_srs"),
     lambda f: (f.tile(crs=None, transform=None), (f.path / "t/a.tfw").write_text("1\n"))),
    ("unknown column named", "refuse", ("nav.csv", "'depth'"),
     text(rows_of(track()), columns={"altitude": "depth"})),
    ("x and y swapped", "refuse", ("may be swapped",), pings(track()[:, [1, 0, 2]])),
    ("kilometres", "refuse", ("may be in kilometres",), pings(track() / [1e3, 1e3, 1.0])),
    ("longitude without its sign", "refuse", ("longitude may lack",), west),
    ("another zone", "refuse", ("km away", "navigation_crs"),
     text(rows_of(track()), navigation_crs="EPSG:32618")),
    ("navigation of half the tile", "name", ("a.tif", "beyond the ends"), pings(track()[:25])),
    ("altitude in whole metres", "name", ("nav.csv", "rounded to steps of 1 m"),
     pings(np.column_stack([track()[:, :2], np.round(np.linspace(4.2, 5.8, NORTH.size))]))),
    ("an altimeter slower than the sonar", "name", ("nav.csv", "interpolated"),
     text("x,y,altitude\n" + SLOW + "\n")),
    ("a wide row", "refuse", ("nav.csv", "row 4"),
     text(rows_of(track()).replace("\n500000.0,3299996.0,5.0", "\n500000,0,3299996,0,5,0"))),
]  # fmt: skip


@pytest.mark.parametrize(
    ("answer", "words", "write"), [k[1:] for k in KINDS], ids=[k[0] for k in KINDS]
)
def test_each_kind_gets_its_answer(tmp_path, answer, words, write):
    folder = Folder(tmp_path)
    write(folder)
    if answer == "refuse":
        with pytest.raises(InputError) as caught:
            folder.open()
        said = caught.value.faults
        assert all("\n" not in line for line in said)
    else:
        survey = folder.open()
        said = survey.warnings
        assert bool(said) == (answer != "same"), said
        near = [p for p in survey.passes if abs(float(np.median(p.track.altitude)) - 5) < 0.5]
        assert bool(near) == (answer != "doubt")
        line = survey.passes[0].track
        assert np.hypot(np.diff(line.x), np.diff(line.y)).max() < 1.5
    assert all(word in " ".join(said) for word in words), said
