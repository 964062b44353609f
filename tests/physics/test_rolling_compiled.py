"""A law that divides by zero hands on a number that is none; nothing is printed from within a callback."""

import numpy as np
from numba import cfunc, types
from numpy.testing import assert_array_equal

from disctrack.rolling import _compiled  # noqa: F401  (which teaches numba complex division)


def test_complex_numbers_are_divided_as_in_python_and_by_zero_without_a_word(capfd, rng):
    numbers = types.CPointer(types.complex128)

    @cfunc(types.void(numbers), error_model="numpy")
    def divided(p):
        p[2] = p[0] / p[1]

    for a, b in (rng.standard_normal((20, 2, 2)) * [1.0, 1e-30]).view(complex)[..., 0]:
        three = np.array([a, b, 0.0])
        divided.ctypes(three.ctypes.data)
        assert three[2] == complex(a) / complex(b)
    three = np.array([1.0 + 1.0j, 0.0, 0.0])
    divided.ctypes(three.ctypes.data)
    assert_array_equal(three[2], complex(np.nan, np.nan))
    assert capfd.readouterr().err == ""
