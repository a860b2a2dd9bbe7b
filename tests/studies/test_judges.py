"""What the studies' judges are made of: rulers, floors, echoes and beamformer, told what is so."""

import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sasmap.simulate import coherent_cell

sys.path.append(str(Path(__file__).resolve().parents[2] / "pipelines" / "studies"))
import heightfields
import judged
import patches
import shadow_method

SIZE, PIXEL = 240, 0.05


def studies(name):
    """A study whose name others may have."""
    path = Path(__file__).resolve().parents[2] / "pipelines" / "studies" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"studies_{name}", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def wave(grid, frequency, degrees, shape=np.sin):
    """A floor of plane waves whose crest normal is so far north of east."""
    turn = np.radians(degrees)
    along = grid.x * np.cos(turn) + grid.y[:, None] * np.sin(turn)
    return shape(2 * np.pi * frequency * along)


@pytest.mark.parametrize("degrees", [-50, 0, 25])
def test_a_beds_own_wave_and_height_are_measured(degrees):
    grid = heightfields.grid_around(SIZE, PIXEL)
    bed = heightfields.measure(grid, 0.05 * wave(grid, 0.83, degrees), SIZE)
    assert bed.frequency == pytest.approx(0.83, rel=2e-3)
    assert np.degrees(np.arctan2(*bed.wave[::-1])) == pytest.approx(degrees, abs=0.5)
    assert bed.median == pytest.approx(0.1, rel=0.01)
    assert bed.significant == pytest.approx(0.1, rel=0.01)
    assert np.median(bed.rises) == pytest.approx(0.5, abs=0.02)


def test_significant_height_is_above_the_median_where_heights_differ():
    grid = heightfields.grid_around(SIZE, PIXEL)
    group = 1 + 0.8 * np.sin(2 * np.pi * grid.x / 11)
    bed = heightfields.measure(grid, 0.05 * group * wave(grid, 0.83, 0), SIZE)
    assert 1.2 * bed.median < bed.significant < 0.2


def test_the_image_of_given_heights_is_that_of_the_same_ripples():
    """Brightness over the ripple's phase, as the simulator's own scene of that ripple has it."""
    frequency, height, phase = 0.8, 0.06, 1.0
    known = {"near": 12.0, "altitude": 5.0, "law": "lambert", "noise": -30.0, "blur": 0.5}
    own = coherent_cell(
        np.random.default_rng(1), frequency=frequency, height=height, phase=phase, pixel_size=PIXEL,
        shape=(SIZE, SIZE), **known,
    ).clip  # fmt: skip
    grid = heightfields.grid_around(SIZE, PIXEL)
    turn = 2 * np.pi * frequency * 0.5 * SIZE * PIXEL
    heights = height * wave(grid, frequency, 0, lambda p: np.sin(p - turn + phase))
    given = heightfields.image(
        np.random.default_rng(2), grid, heights, SIZE, range_flattened=False, **known
    )
    np.testing.assert_allclose(given.ground_range, own.ground_range, atol=1e-9)
    np.testing.assert_allclose(given.x, own.x, atol=1e-9)
    # 240 rows of speckle: 6 % a column and image
    columns = [(clip.amplitude**2).mean(axis=0) for clip in (own, given)]
    smooth = [np.convolve(v, np.ones(3) / 3, "valid") for v in columns]
    assert np.abs(smooth[0] - smooth[1]).max() < 0.25 * smooth[0].max()
    assert np.corrcoef(*smooth)[0, 1] > 0.99


def test_bedforms_rise_as_they_were_drawn_and_the_draws_say_so():
    kind = shadow_method.MEGARIPPLES._replace(asymmetry=(0.6, 0.6), steepness=(0.08, 0.08))
    grid = heightfields.grid_around(SIZE, 0.25)
    floor = shadow_method.bedforms(
        np.random.default_rng(1), kind, 6.0, grid.x + 0 * grid.y[:, None], grid.y[:, None]
    )
    bed = heightfields.measure(grid, floor - floor.mean(), SIZE)
    assert bed.frequency == pytest.approx(1 / 6, rel=0.01)
    assert bed.median == pytest.approx(0.08 * 6, rel=0.02)
    assert np.median(bed.rises) == pytest.approx(0.6, abs=0.03)


@pytest.mark.parametrize(
    ("q", "low", "high"), [(0.2, 0.55, 0.8), (-0.2, 0.2, 0.45), (0, 0.49, 0.51)]
)
def test_rise_of_a_profile(q, low, high):
    """sin x - q sin 2x rises from trough to crest through x = 0, gently where q is above 0."""
    draws = {"peakedness": np.zeros((2, 50)), "asymmetry": np.full((2, 50), float(q))}
    posterior = SimpleNamespace(draws={k: SimpleNamespace(values=v) for k, v in draws.items()})
    rise = shadow_method.rises_of(posterior)
    assert np.all((low < rise) & (rise < high))


def row(quality="good", f=1.0, height=0.05, rank=0.5):
    made = {"quality": quality}
    for name, mean, truth in (("frequency", f, 1.0), ("height", height, 0.05)):
        made |= {f"true_{name}": truth, f"{name}_mean": mean, f"{name}_rank": rank}
        made |= {
            f"{name}_sd": 0.01 * truth,
            f"{name}_low": mean - 0.01,
            f"{name}_high": mean + 0.01,
        }
    return made


def test_summary_counts_what_is_good_and_what_is_far():
    rows = [
        row(),
        row(rank=0.97),
        row(height=0.08, rank=0.0),
        row("not converged"),
        row("no ripples"),
    ]
    rows[-1]["height_mean"] = float("nan")
    cells = [c.strip() for c in judged.summary("x", rows).strip("|").split("|")]
    assert cells[:4] == ["x", "5", "4", "3"]
    assert cells[4:7] == ["33", "33", "0 %"]
    assert cells[7:10] == ["33", "33", "0 %"]
    assert cells[10:] == ["+20 %", "0.40", "1"]


def test_rubins_bedforms_lie_across_the_look_and_none_is_steeper_than_sand():
    pytest.importorskip("pybedforms", reason="pip install -e '.[studies]'")
    beds = studies("beds")
    grid = heightfields.grid_around(SIZE, PIXEL)
    for kind in beds.KINDS:
        floor, truth = beds.height_of(kind, np.random.default_rng(5), grid, SIZE)
        bed = heightfields.measure(grid, floor, SIZE)
        assert abs(np.degrees(np.arctan2(*bed.wave[::-1]))) < 60, kind
        assert 8 < truth["frequency"] * SIZE * PIXEL < 19, kind
        assert 0.01 < 2 * truth["height"] * truth["frequency"] < 0.15, kind
        slope = np.degrees(np.arctan(np.hypot(*np.gradient(floor, PIXEL))))
        assert np.quantile(slope, 0.998) < 36, kind


@pytest.fixture(scope="module")
def recorder():
    pytest.importorskip("openstb.simulator", reason="pip install -e '.[studies]'")
    import rawdata

    made = rawdata.Recorder(rawdata.Sonar())
    yield rawdata, made
    made.close()


def test_a_point_is_focused_where_its_slant_range_lies_on_a_flat_floor(recorder):
    rawdata, made = recorder
    sonar, swath = made.sonar, rawdata.Swath(50, 50, 12.0, 5.0)
    # 0.2 m over the floor, half a pixel off a row: shown nearer than it is
    point = np.array([[1.225, 13.4, 4.8]])
    shown = np.sqrt(13.4**2 + 4.8**2 - 5.0**2)
    raw, places, gate = made.record(point, np.ones(1), swath)
    image = rawdata.backproject(rawdata.compress(raw, sonar), places, gate, sonar, swath)
    power = np.abs(image) ** 2
    along, across = swath.lattice(sonar.pixel)
    near = np.abs(across - shown) < 0.4  # what was recorded
    power = power[:, near]
    assert along @ power.sum(axis=1) / power.sum() == pytest.approx(1.225, abs=0.01)
    assert across[near] @ power.sum(axis=0) / power.sum() == pytest.approx(shown, abs=0.01)
    # all but 2 % within a pixel and a half
    close = np.abs(across[near] - shown) < 0.08
    assert power[np.abs(along - 1.225) < 0.08][:, close].sum() > 0.98 * power.sum()


def test_points_behind_a_crest_are_left_out_and_facing_ones_are_strongest(recorder):
    rawdata, made = recorder
    swath = rawdata.Swath(40, 120, 20.0, 2.0)

    def ridge(along, across):
        return 0.3 * np.exp(-(((across - 22) / 0.4) ** 2)) + 0 * along

    position, strength = rawdata.scatterers(
        ridge, lambda sine: sine**2, made.sonar, swath, 5.0, np.random.default_rng(1)
    )
    across = position[:, 1]
    np.testing.assert_allclose(position[:, 2], 2.0 - ridge(0, across))
    # the ray over the crest comes down 0.3 / 1.7 of its range farther
    counts = [np.sum((across > a) & (across < a + 1)) for a in (20.2, 23.5, 24.8)]
    assert counts[0] > 3500
    assert counts[1] == counts[2] == 0
    facing = (across > 21.5) & (across < 21.8)
    level = (across > 20) & (across < 20.5)
    assert strength[facing].mean() > 3 * strength[level].mean()


def test_a_patch_changes_its_own_square_and_nothing_else():
    rng = np.random.default_rng(1)
    power = rng.exponential(2.0, (patches.SIDE, patches.SIDE))
    levels = {"dark": 0.02, "bright": 16.0, "flat": 2.0}
    for kind, level in levels.items():
        seen = patches.patched(power, kind, 90, rng)
        changed = seen != power
        rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
        assert changed.sum() == rows.size * columns.size == 90**2
        assert seen[changed].mean() == pytest.approx(level, rel=0.1)


def test_a_lit_patch_leaves_no_darkness_and_crests_as_they_are():
    power = np.where(np.arange(patches.SIDE) % 20 < 10, 1e-6, 2.0) * np.ones((patches.SIDE, 1))
    seen = patches.patched(power, "lit", 90, np.random.default_rng(1))
    changed = seen != power
    assert (seen >= power).all()
    dark = (power < 1) & changed
    assert 0.45 * 90**2 < dark.sum() < 0.55 * 90**2
    assert seen[dark].mean() == pytest.approx(0.4 * power.mean(), rel=0.1)
