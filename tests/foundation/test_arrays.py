"""Arrays are validated against a layout of types and shapes."""

import numpy as np
import pytest

from jaxfit.foundation.array_files import validate_arrays


def test_layout_errors_name_the_arrays():
    layout = {"a": ("N 3", np.float32), "b": ("N", np.int64)}
    arrays = validate_arrays({"a": np.ones((2, 3), int), "b": [1, 2]}, layout)
    assert arrays["a"].dtype == np.float32
    with pytest.raises(ValueError, match=r"b must have shape \(N\), not \(3,\): axis 0 should be 2: N is 2 in a"):
        validate_arrays({"a": np.ones((2, 3)), "b": [1, 2, 3]}, layout)
    with pytest.raises(ValueError, match="axis 1 should be 3"):
        validate_arrays({"a": np.ones((2, 4)), "b": [1, 2]}, layout)
    with pytest.raises(ValueError, match="b must be of type int64, not float64"):
        validate_arrays({"a": np.ones((2, 3)), "b": [1.0, 2]}, layout)


def test_read_only_arrays_are_shared_and_others_are_copied():
    given = np.arange(3)
    assert not np.shares_memory(validate_arrays({"a": given}, {"a": ("N", np.int64)})["a"], given)
    given.flags.writeable = False
    assert validate_arrays({"a": given}, {"a": ("N", np.int64)})["a"] is given
    view = np.arange(5)[:3]  # its owner may be written to
    view.flags.writeable = False
    assert not np.shares_memory(validate_arrays({"a": view}, {"a": ("N", np.int64)})["a"], view)
    assert validate_arrays({"a": given}, {"a": ("N", np.float32)})["a"].dtype == np.float32
