"""Edits of tracks: what an exclusion removes, and the text of edits in options and files."""

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.corrected import observations

from jaxfit.cli.main import main
from jaxfit.data.masks import encode_mask
from jaxfit.data.observations import Observations
from jaxfit.data.tracks import track_quality
from jaxfit.fitting.windows import filter_observations
from jaxfit.foundation.errors import InputError
from jaxfit.review.edits import EXAMPLES, Edit, apply_edits, edits_text, parse_edit, read_edits
from jaxfit.review.points import POINT_EXAMPLES, Point

TEXTS = {
    "swap 3,5": Edit("swap", (3, 5)),
    "swap 3,5@120": Edit("swap", (3, 5), 120),
    "swap 3,5@120:200": Edit("swap", (3, 5), 120, 200),
    "swap 3,5@:200": Edit("swap", (3, 5), None, 200),
    "cut 4@80": Edit("cut", (4,), 80),
    "join 2,7": Edit("join", (2, 7)),
    "delete 6": Edit("delete", (6,)),
    "delete 6,8,9": Edit("delete", (6, 8, 9)),
    "exclude 3@10:20": Edit("exclude", (3,), 10, 20),
    "exclude 3@10": Edit("exclude", (3,), 10),
    "exclude 3@:20": Edit("exclude", (3,), None, 20),
    "exclude 3@0": Edit("exclude", (3,), 0),
    "place 3@120 bill_tip 812.4,-300": Point("place", 3, 120, "bill_tip", (812.4, -300.0)),
    "place 3@120 the left eye 8,3": Point("place", 3, 120, "the left eye", (8.0, 3.0)),
    "hide 3@120 bill_tip": Point("hide", 3, 120, "bill_tip"),
    "mirror 3@120": Point("mirror", 3, 120),
    "accept 3@120": Point("accept", 3, 120),
}


def observations_with_masks() -> Observations:
    """The toy birds, each with a mask, a mask of the whole bird, an image of its own and hidden keypoints."""
    plain = observations()
    cells = [(n, t) for n, t in np.argwhere(plain.present).tolist()]
    mask = encode_mask(np.ones((64, 64), bool))
    return dataclasses.replace(
        plain,
        score=plain.present * np.float32(0.5),
        occluded=plain.confidence > 0,
        masks=dict.fromkeys(cells, mask),
        amodal_masks=dict.fromkeys(cells, mask),
        own_images={(n, t): (f"{n}_{t}.png", 64, 64) for n, t in cells},
    )


def test_an_exclusion_removes_all_that_was_detected_there():
    before = observations_with_masks()
    after = apply_edits(before, [Edit("exclude", (4,), 103, 106)], "x")
    gone = np.zeros(before.present.shape, bool)
    gone[1, 3:6] = True
    for name in ("present", "keypoints_px", "confidence", "occluded", "score", "box_px"):
        old, new = getattr(before, name), getattr(after, name)
        assert old[gone].any(), name
        assert not new[gone].any(), name
        np.testing.assert_array_equal(new[~gone], old[~gone], err_msg=name)
    for name in ("masks", "amodal_masks", "own_images"):
        old, new = getattr(before, name), getattr(after, name)
        assert new == {cell: value for cell, value in old.items() if not gone[cell]}, name
    np.testing.assert_array_equal(after.frame_index, before.frame_index)


@pytest.mark.parametrize(
    ("frames", "left"), [((110, None), range(10)), ((None, 110), range(10, 17)), ((110, 111), {*range(17)} - {10})]
)
def test_an_exclusion_reaches_to_the_ends(frames, left):
    after = apply_edits(observations(), [Edit("exclude", (2,), *frames)], "x")
    assert set(np.flatnonzero(after.present[0]).tolist()) == set(left)
    assert track_quality(after)[0].frames == len(left)


def test_a_track_without_frames_disappears():
    before = observations()
    for edit in (Edit("exclude", (5,), 100), Edit("exclude", (5,), 100, 112)):  # track 5 ends at frame 111
        assert apply_edits(before, [edit], "x").track_id.tolist() == [2, 4]
    with pytest.raises(InputError, match=r"exclude 5@100: there is no track 5"):
        apply_edits(before, [Edit("delete", (5,)), Edit("exclude", (5,), 100)], "x")


def test_keypoints_are_placed_hidden_exchanged_and_accepted():
    before, cell = observations(), (1, 4)  # track 4, frame 104
    sure = before.with_keypoints(before.keypoints_px, before.confidence * 0.5)
    k, left, right = (before.keypoint_names.index(name) for name in ("crown", "left_eye", "right_eye"))
    points = [Point("place", 4, 104, "crown", (60.0, 3.5)), Point("hide", 4, 104, "nape"), Point("mirror", 4, 104)]
    after = apply_edits(sure, points, "x")
    assert (after.keypoints_px[*cell, k].tolist(), after.confidence[*cell, k]) == ([60.0, 3.5], 1)
    assert after.confidence[*cell, before.keypoint_names.index("nape")] == 0
    np.testing.assert_array_equal(after.keypoints_px[*cell, left], before.keypoints_px[*cell, right])
    x, y, width, _ = after.box_px[cell]
    assert (x + width, y) == (pytest.approx(60), 3.5)
    others = np.ones(before.present.shape, bool)
    others[cell] = False
    for name in ("keypoints_px", "confidence", "box_px"):
        np.testing.assert_array_equal(getattr(after, name)[others], getattr(sure, name)[others])
    labels = apply_edits(sure, points, "x", only_labels=True)
    assert np.argwhere(labels.confidence).tolist() == [[*cell, k]]
    accepted = apply_edits(sure, [*points, Point("accept", 4, 104)], "x", only_labels=True)
    assert set(accepted.confidence[cell]) == {0, 1}
    assert (accepted.confidence > 0).sum() == before.num_keypoints - 1  # one is hidden


def test_keypoints_name_the_bird_of_the_result_and_the_filter_leaves_them():
    edits = [Edit("swap", (2, 4)), Point("place", 4, 104, "crown", (60.0, 3.5))]
    after = apply_edits(observations(), edits, "x")
    k = after.keypoint_names.index("crown")
    assert after.track_id.tolist() == [2, 4, 5]
    assert after.keypoints_px[0, 4, k].tolist() == [60.0, 3.5]
    filtered = filter_observations(after, 5)
    assert filtered.keypoints_px[0, 4, k].tolist() == [60.0, 3.5]
    assert np.linalg.norm(filtered.keypoints_px[0, 5, k] - after.keypoints_px[0, 5, k]) < 5


@pytest.mark.parametrize(
    ("point", "message"),
    [
        (Point("place", 4, 104, "crown", (64.5, 3.0)), "outside the picture of 64×64"),
        (Point("place", 4, 104, "knee", (6.0, 3.0)), "there is no such keypoint"),
        (Point("mirror", 9, 104), "bird 9 is not in frame 104"),
        (Point("accept", 5, 113), "bird 5 is not in frame 113"),
    ],
)
def test_wrong_keypoints_are_one_line(point, message):
    with pytest.raises(InputError, match=message):
        apply_edits(observations(), [point], "x")


def test_many_edits_move_the_arrays_once(tmp_path, monkeypatch):
    path, moves = tmp_path / "edits.txt", []
    path.write_text("cut 4@110\n" * 120_000)
    monkeypatch.setattr("jaxfit.review.edits.replace", lambda *a, **k: moves.append(1) or dataclasses.replace(*a, **k))
    after = apply_edits(observations(), read_edits(path), "x")
    assert len(moves) == 1
    assert after.track_id.tolist() == [2, 4, 5, 6]  # later cuts find no bird to move
    assert np.flatnonzero(after.present[3]).tolist() == list(range(10, 17))


def test_cuts_are_bounded_by_the_memory(monkeypatch):
    monkeypatch.setattr("jaxfit.review.edits.observations_bytes", lambda tracks, *_: 1e9 * tracks)
    with pytest.raises(InputError, match=r"x: 4 tracks over 17 frames need 4.0 GB, more than 2 GB \(cut less\)"):
        apply_edits(observations(), [Edit("cut", (4,), 110)], "x")


@pytest.mark.parametrize("text", TEXTS)
def test_the_text_of_an_edit(text):
    assert parse_edit(text, "x") == TEXTS[text]
    assert str(TEXTS[text]) == text
    assert all(parse_edit(f"{kind} {example}", "x").kind == kind for kind, example in EXAMPLES.items())


WRONG = [
    *("swap 3", "swap 3,5@:", "swap 3, 5", "Swap 3,5", "cut 4", "cut 4@80:90", "cut 4,5@80", "join 2,7@10", "delete"),
    *(
        "place 3@10 bill_tip",
        "place 3@10 1,2",
        "hide 3@10",
        "hide 3@10 a 1,2",
        "mirror 3",
        "accept 3@1 a",
        "place 3,4@1 a 1,2",
    ),
    *("exclude 3", "exclude 3,4@10:20", "exclude 3@1.5", "", "split 3@10", "delete 6\n", "cut 4@" + 19 * "1"),
]


@pytest.mark.parametrize("text", WRONG)
def test_other_texts_are_not_edits(text):
    with pytest.raises(InputError, match="is not a correction") as caught:
        parse_edit(text, "birds.txt")
    kind = text.split(" ")[0]
    examples = EXAMPLES | POINT_EXAMPLES
    for each in [kind] if kind in examples else EXAMPLES:
        assert f"{each} {examples[each]}" in caught.value.remedy
    assert ("delete removes all frames of a track" in caught.value.remedy) == (kind == "exclude")


FRAME = st.integers(0, 10**18 - 1)
TRACK = st.integers(0, 10**18 - 1)
EDITS = st.one_of(
    st.builds(Edit, st.just("swap"), st.tuples(TRACK, TRACK), st.none() | FRAME, st.none() | FRAME),
    st.builds(Edit, st.just("cut"), st.tuples(TRACK), FRAME, st.none()),
    st.builds(Edit, st.just("join"), st.tuples(TRACK, TRACK), st.none(), st.none()),
    st.builds(Edit, st.just("delete"), st.lists(TRACK, min_size=1, max_size=4).map(tuple), st.none(), st.none()),
    st.builds(Edit, st.just("exclude"), st.tuples(TRACK), FRAME, st.none() | FRAME),
    st.builds(Edit, st.just("exclude"), st.tuples(TRACK), st.none(), FRAME),
    st.builds(Point, st.just("mirror"), TRACK, FRAME, st.just(""), st.none()),
)


@pytest.fixture(scope="module")
def edits_file(tmp_path_factory):
    return tmp_path_factory.mktemp("edits") / "edits.txt"


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(edits=st.lists(EDITS, max_size=5))
def test_a_file_of_edits_comes_back(edits_file, edits):
    edits_file.write_text(edits_text(edits), encoding="utf-8")
    assert read_edits(edits_file) == edits


def test_comments_and_empty_lines_are_ignored(tmp_path):
    path = tmp_path / "edits.txt"
    path.write_bytes("\ufeff# two birds cross\r\n\r\n  swap 3,5@120:200\t\r\n   # é\r\nexclude 3@10".encode())
    assert read_edits(path) == [Edit("swap", (3, 5), 120, 200), Edit("exclude", (3,), 10)]
    path.write_text("# nothing\n\n")
    assert read_edits(path) == []


FILES = {
    "wrong line": (
        b"# one\n\ncut 4@80\nexclude 3\nswap\n",
        "edits.txt: line 4: 'exclude 3' is not a correction (write for example exclude 3@10:20; delete",
    ),
    "unknown kind": (
        b"cut 4@80\nsplit 4@80\n",
        "edits.txt: line 2: 'split 4@80' is not a correction (write for example swap 3,5@120:200, cut 4@80, join 2,7, "
        "delete 6, exclude 3@10:20)",
    ),
    "nothing": (b"# nothing\n", "edits.txt: holds no correction (write one a line, for example swap 3,5@120:200)"),
    "unknown track": (b"exclude 9@110\n", "exclude 9@110: there is no track 9 (its tracks are 2, 4, 5)"),
}


@pytest.mark.parametrize("case", FILES)
def test_wrong_files_are_one_line(folder, tmp_path, capsys, case):
    content, message = FILES[case]
    path = tmp_path / "edits.txt"
    path.write_bytes(content)
    assert main(["tracks", str(folder), "--edits", str(path), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert len(error) <= 301
    assert not (tmp_path / "out").exists()


def test_a_file_needs_a_folder_for_the_result(folder, tmp_path, capsys):
    path = tmp_path / "edits.txt"
    path.write_text("delete 5\n")
    assert main(["tracks", str(folder), "--edits", str(path)]) == 2
    assert "has corrections, but no folder for the new result (give --out)" in capsys.readouterr().err


def test_corrections_of_a_file_come_before_those_of_options(folder, tmp_path, monkeypatch):
    called = []
    monkeypatch.setattr(
        "jaxfit.review.correct.apply_edits", lambda before, edits, source: called.extend(edits) or before
    )
    path = tmp_path / "edits.txt"
    path.write_text("cut 4@110\ndelete 5\n")
    options = ["--exclude", "2@103:105", "--join", "4,6"]
    # exit code 0: nothing changes, so nothing is fitted
    assert main(["tracks", str(folder), *options, "--edits", str(path), "--out", str(tmp_path / "out")]) == 0
    assert list(map(str, called)) == ["cut 4@110", "delete 5", "exclude 2@103:105", "join 4,6"]
    corrections = tmp_path / "corrections.txt"
    corrections.write_text(edits_text(called))
    assert read_edits(corrections) == called
