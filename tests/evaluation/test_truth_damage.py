"""Damaged folders of scenes end in a truth or in one error."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.hostile import Isolated, many_examples
from support.mutations import damaged_bytes, damaged_tree

from jaxfit.evaluation.truth import read_behaviours, read_truth
from jaxfit.foundation.errors import InputError

SCENE = {
    "birds": 2,
    "seed": 1,
    "behaviour": {
        "3": [{"from_frame": 0, "behaviour": "stand"}, {"from_frame": 7, "behaviour": "preen"}],
        "5": [{"from_frame": 0, "behaviour": "preen"}],
    },
}


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


@pytest.mark.extended
def test_damaged_scenes(tmp_path):
    trees = damaged_tree(SCENE).map(lambda tree: json.dumps(tree).encode())
    with Isolated("jaxfit.evaluation.truth:read_behaviours") as reader:

        @many_examples
        @given(st.one_of(damaged_bytes(json.dumps(SCENE).encode()), trees))
        def check(damaged):
            (tmp_path / "scene.json").write_bytes(damaged)
            outcome = reader(tmp_path)
            assert outcome.acceptable, outcome

        check()
