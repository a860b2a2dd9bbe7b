import numpy as np
import pytest
from scipy import stats
from scipy.ndimage import gaussian_filter

from sasmap.run.class_models import model_text, read_model
from sasmap.sediments import segmentation
from sasmap.sediments.classmap import class_map, log_likelihoods
from sasmap.sediments.description import LEVELS, block_texture
from sasmap.sediments.grouping import bhattacharyya
from sasmap.sediments.segmentation import find_classes
from sasmap.sediments.texture import LAGS, SCALES, channels
from sasmap.sediments.training import train_classes
from sasmap.sediments.trends import AmplitudeGrid

SIZE = 384


def bed(seed, width, nu=1.5):
    """K speckle whose texture is correlated over so many pixels; the histogram is always one."""
    rng = np.random.default_rng(seed)
    field = rng.normal(size=(SIZE, SIZE))
    field = gaussian_filter(field, width, mode="wrap") if width else field
    texture = stats.gamma.ppf(stats.norm.cdf(field / field.std()), nu) / nu
    return np.sqrt(texture / 2) * np.hypot(*rng.normal(size=(2, SIZE, SIZE)))


def halves(seed, widths=(0.0, 5.0), levels=(1.0, 1.0)):
    """Two beds on either side of a wavy edge, as one look; and which is where."""
    y, x = np.indices((SIZE, SIZE))
    truth = (x > SIZE / 2 + 20 * np.sin(y / 40)).astype(int)
    beds = [
        level * bed(seed + k, w) for k, (w, level) in enumerate(zip(widths, levels, strict=True))
    ]
    return [AmplitudeGrid(np.where(truth, beds[1], beds[0]), np.full(truth.shape, 5.0))], truth


def agreement(label, truth):
    """Share of pixels that are right, whatever the classes' numbers."""
    right = (label == truth + 1).mean()
    return max(right, ((label > 0) & (label != truth + 1)).mean())


def test_beds_of_one_histogram_are_told_by_their_texture():
    for seed in (1, 5):
        looks, truth = halves(seed)
        classes = find_classes(looks)
        assert len(classes.laws) == 2
        assert classes.texture is not None
        label = class_map(log_likelihoods(looks, classes)).label
        assert agreement(label, truth) > 0.96


def test_a_boundary_favours_neither_bed():
    """Though one has more evidence a pixel: ten pixels would be lost to it."""
    for seed, widths in ((1, (2.0, 0.0)), (11, (2.0, 0.0)), (21, (0.0, 3.0))):
        looks, truth = halves(seed, widths)
        label = class_map(log_likelihoods(looks, find_classes(looks))).label
        if (label == truth + 1).mean() < 0.5:
            label = 3 - label
        shift = (label == 2).sum(axis=1) - (truth == 1).sum(axis=1)
        assert abs(shift.mean()) < 5


def test_texture_is_left_out_where_amplitude_suffices():
    looks, _ = halves(3, (0.0, 0.0), (1.0, 2.0))
    assert find_classes(looks).texture is None
    one = [AmplitudeGrid(bed(4, 3.0), np.full((SIZE, SIZE), 5.0))]
    assert len(find_classes(one).laws) == 1


def test_what_is_left_of_ripples_is_no_texture():
    looks, truth = halves(1)
    assert len(find_classes(looks, rippled=truth.astype(np.uint8)).laws) == 1
    assert len(find_classes(looks, rippled=np.zeros(truth.shape, np.uint8)).laws) == 2


@pytest.mark.parametrize("levels", [(1.0, 1.0), (1.0, 2.5)])
def test_trained_classes_take_texture_where_it_tells_more(levels):
    looks, truth = halves(6, (0.0, 5.0) if levels[1] == 1 else (0.0, 0.0), levels)
    marks = np.zeros(truth.shape, np.uint8)
    marks[:200, :150], marks[:200, 230:] = 1, 2
    classes = train_classes(looks, marks, 2)
    assert (classes.texture is None) == (levels[1] > 1)
    label = class_map(log_likelihoods(looks, classes), 2).label
    assert (label[200:] == truth[200:] + 1).mean() > 0.95


def test_channels_see_the_scale_at_which_texture_ends():
    white, smooth = (channels(np.log(bed(7, w))) for w in (0.0, 5.0))
    assert white[0].std() == pytest.approx(smooth[0].std(), rel=0.05)
    coarse = len(SCALES) - 2  # 8 pixels
    assert smooth[coarse].std() > 2 * white[coarse].std()
    apart = len(SCALES) + LAGS.index(8)
    assert np.median(smooth[apart]) > 2 * np.median(white[apart])


def test_what_is_unknown_tells_nothing():
    logs = np.log(bed(8, 2.0))
    whole = channels(logs)
    logs[:, 200:] = np.nan
    part = channels(logs)
    assert np.isnan(part[:, :, 200:]).all()
    np.testing.assert_allclose(part[:, :, :180], whole[:, :, :180], rtol=1e-4, atol=1e-5)
    assert np.isfinite(part[:, :, :200]).all()


def test_blocks_are_described_as_their_pixels_are():
    """A few averages tell what all do: level, scatter and differences at each scale."""
    image = bed(3, 3.0)
    found = channels(np.log(image))
    sums = block_texture(image).astype(float)
    count, split = sums[..., 0].sum(), len(LEVELS)
    means = sums[..., 1:].sum(axis=(0, 1)) / count
    for k in range(split):
        assert means[k] == pytest.approx(found[k].mean(), abs=0.01)
        wanted = found[k].var()
        assert means[split + k] - means[k] ** 2 == pytest.approx(wanted, rel=0.03)
        wanted = (found[len(SCALES) + k] ** 2).mean()
        assert means[2 * split + k] == pytest.approx(wanted, rel=0.05)


def test_unknown_pixels_do_not_describe_a_block():
    image = np.full((48, 48), 3.0)
    image[:, 24:] = np.nan
    sums = block_texture(image)
    assert (sums[:, 0, 0] == 256).all()
    assert (sums[:, 1, 0] == 128).all()
    assert (sums[:, 2] == 0).all()
    split = len(LEVELS)
    half = sums[:, 1, 1:] / sums[:, 1, :1]
    assert half[:, :split] == pytest.approx(np.log(3.0), abs=1e-5)
    assert half[:, 2 * split :] == pytest.approx(0.0, abs=1e-9)


def test_textures_go_to_other_surveys(tmp_path):
    looks, truth = halves(9)
    classes = find_classes(looks)
    (tmp_path / "classes.json").write_text(model_text(("a", "b"), ("", "mS"), classes))
    model = read_model(tmp_path / "classes.json")
    assert model.codes == ("", "mS")
    others, _ = halves(19)
    again = [
        log_likelihoods(others, c)
        for c in (
            classes,
            classes.__class__(
                model.laws, classes.trends, model.centre, classes.noise_factor, None, model.texture
            ),
        )
    ]
    np.testing.assert_allclose(again[0], again[1], atol=0.05)
    assert agreement(class_map(again[1]).label, truth) > 0.95


def test_distance_of_gaussians():
    one = np.zeros(2), np.eye(2)
    assert bhattacharyya(one, one) == pytest.approx(0)
    # of equal spread an eighth of the square distance
    assert bhattacharyya(one, (np.array([4.0, 0.0]), np.eye(2))) == pytest.approx(2)
    wide = np.zeros(2), 4 * np.eye(2)
    assert bhattacharyya(one, wide) == pytest.approx(np.log(2.5) - np.log(2))


def test_textures_are_told_from_a_part_of_a_survey(monkeypatch):
    for limit in ("DESCRIBED", "SAMPLE"):
        monkeypatch.setattr(segmentation, limit, 75_000)
    monkeypatch.setattr(segmentation, "SAMPLED_SIDE", 96)  # eight tiles of sixteen
    looks, truth = halves(5)
    classes = find_classes(looks)
    assert len(classes.laws) == 2
    assert classes.texture is not None
    label = class_map(log_likelihoods(looks, classes)).label
    assert agreement(label, truth) > 0.95
