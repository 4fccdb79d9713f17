"""The largest table of keypoints."""

from pathlib import Path

import pytest

from jaxfit.data.formats.keypoint_table import check_table_size
from jaxfit.foundation.errors import InputError


def test_tables_have_a_largest_size():
    check_table_size(Path("hour.h5"), 15, 90_000, 25)
    for size in ((1000, 100_000, 20), (1, 10_000_000, 25)):
        with pytest.raises(InputError, match="too many for one table"):
            check_table_size(Path("large.h5"), *size)
