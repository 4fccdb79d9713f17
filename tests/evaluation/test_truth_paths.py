"""Paths and behaviours that are no truth end in one error."""

import json

import pytest

from jaxfit.evaluation.truth import read_behaviours, read_truth
from jaxfit.foundation.errors import InputError


@pytest.mark.parametrize("track", ["3\u0663", "1" * 5000, "007", "-1", ""])
def test_behaviours_of_what_is_no_track_id(tmp_path, track):
    (tmp_path / "scene.json").write_text(json.dumps({"behaviour": {track: [{"from_frame": 0, "behaviour": "x"}]}}))
    with pytest.raises(InputError, match="must be the behaviours of a track id"):
        read_behaviours(tmp_path)


def test_truths_that_are_no_files(tmp_path):
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for path in (tmp_path / "loop", tmp_path / ("a" * 300), tmp_path / "a\0b", "/dev/zero"):
        with pytest.raises(InputError) as caught:
            read_truth(path)
        assert str(caught.value).isprintable()
