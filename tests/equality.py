"""Equality of results to the last bit, as of those that were written and read back."""

from dataclasses import fields, is_dataclass

import numpy as np
from numpy.testing import assert_array_equal


def assert_equal(a, b, name=""):
    """Of dataclasses, tuples, arrays and their types; NaN equals NaN."""
    assert type(a) is type(b), name
    if is_dataclass(a):
        for field in fields(a):
            assert_equal(getattr(a, field.name), getattr(b, field.name), f"{name}.{field.name}")
    elif isinstance(a, tuple):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_equal(x, y, f"{name}[{i}]")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, name
        assert_array_equal(a, b, err_msg=name)
    else:
        assert a == b, name
