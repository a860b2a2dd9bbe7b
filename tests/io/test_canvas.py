import numpy as np
import pytest

from sasmap.io.canvas import Canvas

PARTS = [
    (slice(0, 7), slice(0, 11)),
    (slice(2, 5), slice(3, 9)),
    (slice(6, 20), slice(10, 30)),
    (slice(3, 3), slice(0, 4)),
    slice(1, 4),
]


@pytest.mark.parametrize("dtype", ["uint8", "int8", "float32"])
def test_slices_are_those_of_an_array(tmp_path, dtype):
    rng = np.random.default_rng(1)
    plain = np.zeros((7, 11), dtype)
    with Canvas(tmp_path / "a.part", plain.shape, dtype, 4) as canvas:
        for part in PARTS:
            values = rng.integers(0, 100, plain[part].shape).astype(dtype)
            plain[part] = values
            canvas[part] = values
            for other in PARTS:
                np.testing.assert_array_equal(canvas[other], plain[other])
    assert not list(tmp_path.iterdir())


def test_a_canvas_cut_short_is_an_error(tmp_path):
    with Canvas(tmp_path / "a.part", (10, 10), "uint8") as canvas:
        (tmp_path / "a.part").write_bytes(b"1234")
        with pytest.raises(OSError, match="ends too early"):
            canvas[slice(0, 10)]
