"""NWB files: one subject a file, valid by pynwb, and equal to the result."""

import numpy as np
import pytest
from support.birds import error_bars
from support.exported import BIRD, FPS, FRAMES, TRACKS, solution, write_result
from support.films import encode

import jaxfit
from jaxfit.cli.main import main
from jaxfit.foundation.errors import InputError

pynwb = pytest.importorskip("pynwb", reason="pynwb is not installed")
pytest.importorskip("ndx_pose", reason="ndx-pose is not installed")


SHAPE = len(TRACKS), len(FRAMES), BIRD.num_keypoints
VARIANCE = np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A result with error bars and flags, and the folder of its files."""
    folder = tmp_path_factory.mktemp("nwb")
    doubts = np.zeros(SHAPE[:2], np.int8)
    doubts[1] = [1, -1, -1, 4, 12]
    bars = error_bars(solution(), keypoints_px_cov=VARIANCE[..., None, None] * np.diag([1, 4]))
    made = write_result(folder / "result", video="/films/a/clip.mp4", **bars, doubts=doubts)
    jaxfit.export_result(folder / "result", "nwb", folder / "nwb", start="2024-06-01T12:00:00+02:00")
    return made, folder / "nwb"


def test_a_file_holds_one_bird_and_its_keypoints(written):
    """Positions, and standard deviations in the order of the skeleton."""
    made, folder = written
    assert sorted(path.name for path in folder.iterdir()) == ["bird_3.nwb", "bird_7.nwb", "export.json"]
    path = folder / "bird_7.nwb"
    assert not pynwb.validate(path=path)
    with pynwb.NWBHDF5IO(path, "r") as io:
        file = io.read()
        pose, sd = file.processing["behavior"]["PoseEstimation"], file.processing["behavior"]["keypoints_sd"]
        assert file.subject.subject_id == "bird_7"
        assert "partly diverged" in file.notes
        assert pose.source_video.external_file[0] == "/films/a/clip.mp4"
        assert list(pose.skeleton.nodes) == list(made.keypoint_names)
        for k, name in enumerate(made.keypoint_names):
            series = pose[name]
            expected = np.where(made.valid[1][:, None], made.keypoints.px[1, :, k], np.nan)
            np.testing.assert_array_equal(series.data[:], expected)
            np.testing.assert_allclose(series.timestamps[:], np.array(FRAMES) / FPS)
            assert np.isnan(series.confidence[:]).all()
            assert "NaN where the result does not hold detections" in series.confidence_definition
        expected = np.sqrt(VARIANCE[1])[..., None] * [1, 2]
        expected[~made.valid[1]] = np.nan
        np.testing.assert_allclose(sd.data[:], expected, rtol=1e-6)
        np.testing.assert_allclose(sd.timestamps[:], np.array(FRAMES) / FPS)
        assert sd.unit == "pixels"
        assert "networks these values are too small" in sd.description


def test_flags_are_intervals(written):
    """An interval for each range of frames with one flag."""
    with pynwb.NWBHDF5IO(written[1] / "bird_7.nwb", "r") as io:
        rows = io.read().intervals["pose_flags"].to_dataframe()
    assert rows.flag.tolist() == ["contradicted", "unsure"]
    assert rows.doubts.tolist() == [
        "keypoints far from the pose",
        "a second pose fits almost as well; error bars above 10 % of the length",
    ]
    step = 2 / FPS  # every second frame was used
    np.testing.assert_allclose(rows.start_time, [10 / FPS, 18 / FPS])
    np.testing.assert_allclose(rows.stop_time, [10 / FPS + step, 20 / FPS + step])


@pytest.mark.parametrize("stored", [True, False])
@pytest.mark.parametrize("first", [0, 132])
def test_poses_and_footage_have_one_clock(tmp_path, first, stored):
    """The film has a variable frame rate, and may begin late; the result has its times, or names the film only."""
    ticks = np.concatenate([first + np.cumsum([0, *[4, 3, 4, 9, 1] * 4]), [999]])
    film = encode(tmp_path / "film.mkv", count=len(ticks), ticks=ticks.tolist())
    times_s = ticks[list(FRAMES)] / 100 if stored else None
    write_result(tmp_path / "result", video=film, timestamp_s=times_s)
    jaxfit.export_result(tmp_path / "result", "nwb", tmp_path / "nwb")
    with pynwb.NWBHDF5IO(tmp_path / "nwb" / "bird_7.nwb", "r") as io:
        file = io.read()
        footage_s = file.acquisition["footage"].timestamps[:]
        np.testing.assert_allclose(footage_s, ticks / 100, atol=1e-3)
        pose = file.processing["behavior"]["PoseEstimation"]
        pose_s = next(iter(pose.pose_estimation_series.values())).timestamps[:]
        np.testing.assert_allclose(pose_s, footage_s[list(FRAMES)], atol=1e-3)


def test_names_with_slashes():
    from jaxfit.export.pose_files import _series_names

    assert _series_names(("a/b", "a:b", "a_b", "c")) == ["a_b", "a_b_", "a_b__", "c"]


def test_wrong_use(tmp_path, capsys):
    write_result(tmp_path / "result")
    arguments = ["export", str(tmp_path / "result"), "--to", "nwb", "--out", str(tmp_path / "nwb")]
    assert main(arguments) == 2
    assert "does not name its footage" in capsys.readouterr().err
    (tmp_path / "film.mp4").write_bytes(b"no film")
    with pytest.raises(InputError, match=r"film\.mp4"):
        jaxfit.export_result(tmp_path / "result", "nwb", tmp_path / "nwb", video=tmp_path / "film.mp4")
    assert not (tmp_path / "nwb").exists()
