"""Corrections of tracks: only changed windows are fitted again, and the result is that of a fit of all windows."""

import dataclasses
import json

import numpy as np
import pytest
from support.corrected import BIRD, CONFIG, TRACKS, observations, write

import jaxfit
from jaxfit.cli.main import main
from jaxfit.data.solution import LAYOUT
from jaxfit.foundation.errors import InputError
from jaxfit.review.correct import correct_tracks, refit
from jaxfit.review.edits import Edit, apply_edits

CELLS = [name for name, (shape, _) in LAYOUT.items() if shape.startswith("N T")]


CASES = {
    "swap the last window": ([Edit("swap", (2, 4), 112)], 4),
    "cut inside a window": ([Edit("cut", (4,), 108)], 3),
    "join what was cut": ([Edit("cut", (2,), 109), Edit("join", (2, 6))], 0),
    "delete": ([Edit("delete", (4,))], 0),
    "exclude in the middle of a window": ([Edit("exclude", (4,), 108, 110)], 1),
    "exclude a whole window": ([Edit("exclude", (4,), 106, 112)], 2),
}
FILTERED_BESIDE = ("swap the last", "exclude a whole")
"""The median filter also changes frames beside these corrections."""


@pytest.mark.parametrize(
    "case",
    [
        case if case.startswith(("swap the", "exclude in")) else pytest.param(case, marks=pytest.mark.extended)
        for case in CASES
    ],
)
def test_only_changed_windows_are_fitted_again(folder, tmp_path, monkeypatch, case):
    edits, fitted = CASES[case]
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    done = correct_tracks(folder, tmp_path / "out", edits)
    if not case.startswith(FILTERED_BESIDE):
        assert len(done.fitted) == fitted
    else:
        assert 0 < len(done.fitted) < done.windows
    read, _ = jaxfit.load_solution(tmp_path / "out")
    corrected = apply_edits(observations(), edits, "observations")
    expected = jaxfit.fit(corrected, BIRD, CONFIG)
    for name in ("track_id", "status", *CELLS):
        np.testing.assert_array_equal(read.arrays()[name], expected.arrays()[name], err_msg=name)
    for term in expected.loss:
        known = np.isfinite(read.loss[term])
        np.testing.assert_array_equal(read.loss[term][known], expected.loss[term][known])
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["corrections"] == [str(edit) for edit in edits]
    assert summary["video"] == {"file": "clip.mp4"}
    stored = jaxfit.read_coco(tmp_path / "out" / "observations.json")
    np.testing.assert_array_equal(stored.keypoints_px, corrected.select(np.argsort(corrected.track_id)).keypoints_px)


@pytest.mark.parametrize(
    ("edit", "fitted"),
    [
        # windows begin at frames 100, 104, 108 and 112; the window beside a changed window is fitted again, too
        (Edit("cut", (2,), 115), {(2, 108, 113), (2, 112, 114), (6, 115, 116)}),
        # the second part begins where a window began that shared frames with an earlier window
        pytest.param(Edit("cut", (4,), 108), None, marks=pytest.mark.extended),
    ],
)
def test_windows_that_share_frames_are_fitted_with_their_neighbours(tmp_path, edit, fitted):
    shared = dataclasses.replace(CONFIG, overlap=2, filter_window=1)
    write(tmp_path / "result", shared)
    done = correct_tracks(tmp_path / "result", tmp_path / "out", [edit])
    assert fitted is None or set(done.fitted) == fitted
    assert len(done.fitted) < done.windows
    read, _ = jaxfit.load_solution(tmp_path / "out")
    expected = jaxfit.fit(apply_edits(observations(), [edit], "observations"), BIRD, shared)
    for name in ("track_id", "status", *CELLS):
        np.testing.assert_array_equal(read.arrays()[name], expected.arrays()[name], err_msg=name)


def test_a_track_whose_remaining_frames_are_not_usable_has_no_window():
    """Frame 100 of track 4 has two keypoints, too few for a fit; without its other frames, nothing is fitted."""
    before = observations()
    confidence = before.confidence.copy()
    confidence[1, 0, 2:] = 0
    before = before.with_keypoints(before.keypoints_px, confidence)
    after = apply_edits(before, [Edit("exclude", (4,), 101)], "x")
    done = refit(jaxfit.fit(before, BIRD, CONFIG), before, after, BIRD, CONFIG)
    assert not done.fitted
    assert done.solution.track_id.tolist() == [2, 4, 5]
    assert done.solution.valid.sum(1).tolist() == [17, 0, 12]
    assert done.solution.status[1] == jaxfit.fit(after, BIRD, CONFIG).status[1]


def test_edits_move_birds():
    before = observations()
    after = apply_edits(before, [Edit("swap", (2, 5), 110, 113)], "x")
    np.testing.assert_array_equal(after.keypoints_px[0, 10:12], before.keypoints_px[2, 10:12])
    np.testing.assert_array_equal(after.keypoints_px[2, 10:13], before.keypoints_px[0, 10:13])
    assert not after.present[0, 12]
    assert after.present[2, 12]
    cut = apply_edits(before, [Edit("cut", (4,), 103)], "x")
    assert cut.track_id.tolist() == [2, 4, 5, 6]
    np.testing.assert_array_equal(cut.present.sum(1), [17, 3, 12, 14])
    joined = apply_edits(cut, [Edit("delete", (5,)), Edit("join", (4, 6))], "x")
    assert joined.track_id.tolist() == [2, 4]
    np.testing.assert_array_equal(joined.keypoints_px, before.keypoints_px[:2])


WRONG = {
    "unknown track": (["--swap", "2,9@110"], "swap 2,9@110: there is no track 9 (its tracks are 2, 4, 5)"),
    "unknown frame": (["--cut", "2@999"], "cut 2@999: there are no such frames (its frames are 100:117)"),
    "overlap": (["--join", "2,4"], "join 2,4: both tracks have a bird in frame 100"),
    "nothing left": (["--delete", "2,4,5"], "has no track left"),
    "no frame": (["--cut", "2"], "--cut: cannot be '2' (write for example --cut 4@80)"),
    "exclusion without frames": (
        ["--exclude", "2"],
        "--exclude: cannot be '2' (write for example --exclude 3@10:20; --delete removes all frames of a track)",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_corrections_are_one_line(folder, tmp_path, capsys, case):
    arguments, message = WRONG[case]
    assert main(["tracks", str(folder), "--out", str(tmp_path / "out"), *arguments]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_the_list_and_missing_observations(folder, tmp_path, capsys):
    assert main(["tracks", str(folder)]) == 0
    assert all(str(track) in capsys.readouterr().out for track in TRACKS[:1])
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in folder.iterdir():
        if path.name != "observations.json":
            (bare / path.name).write_bytes(path.read_bytes())
    with pytest.raises(InputError, match="give the observations of the fit by --observations"):
        correct_tracks(bare, tmp_path / "out", [Edit("delete", (2,))])
    done = correct_tracks(bare, tmp_path / "out", [Edit("delete", (2,))], folder / "observations.json")
    assert done.solution.track_id.tolist() == [4, 5]
    with pytest.raises(InputError, match="is the result itself"):
        correct_tracks(folder, folder, [Edit("delete", (2,))], overwrite=True)
