import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from skimage.measure import label as measure_label

from sasmap.sediments.patches import counted, patches, rims


@pytest.mark.parametrize("classes", [2, 4])
def test_patches_and_rims_are_those_of_other_libraries(classes):
    label = np.random.default_rng(classes).integers(0, classes, (61, 83)).astype(np.uint8)
    number, size = patches(label)
    other = measure_label(label, background=0, connectivity=1)
    pairs = np.unique(np.stack([number.ravel(), other.ravel()]), axis=1)
    assert pairs.shape[1] == size.size == other.max() + 1
    np.testing.assert_array_equal(size, np.bincount(number.ravel()))
    np.testing.assert_array_equal(counted(label), np.bincount(label.ravel(), minlength=256))
    mask = label > 0
    expected = np.argwhere(mask & binary_dilation(~mask, np.ones((3, 3))))
    np.testing.assert_array_equal(rims(mask), expected)


def test_a_whole_mask_has_no_rim():
    assert rims(np.ones((5, 7), bool)).shape == (0, 2)
