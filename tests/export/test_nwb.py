"""NWB files: one subject a file, valid by pynwb, and equal to the result."""

import numpy as np
import pytest
from support.exported import BIRD, FPS, FRAMES, TRACKS, error_bars, write_result

import jaxfit
from jaxfit.cli.main import main
from jaxfit.foundation.errors import InputError

pynwb = pytest.importorskip("pynwb", reason="pynwb is not installed")
pytest.importorskip("ndx_pose", reason="ndx-pose is not installed")


def test_a_file_holds_one_bird_and_its_keypoints(tmp_path):
    made = write_result(tmp_path / "result", video="/films/a/clip.mp4")
    jaxfit.export_result(tmp_path / "result", "nwb", tmp_path / "nwb", start="2024-06-01T12:00:00+02:00")
    assert sorted(path.name for path in (tmp_path / "nwb").iterdir()) == ["bird_3.nwb", "bird_7.nwb", "export.json"]
    path = tmp_path / "nwb" / "bird_7.nwb"
    assert not pynwb.validate(path=path)
    with pynwb.NWBHDF5IO(path, "r") as io:
        file = io.read()
        pose = file.processing["behavior"]["PoseEstimation"]
        assert file.subject.subject_id == "bird_7"
        assert "partly diverged" in file.notes
        assert pose.source_video.external_file[0] == "/films/a/clip.mp4"
        assert list(pose.skeleton.nodes) == list(made.keypoint_names)
        for k, name in enumerate(made.keypoint_names):
            series = pose[name]
            expected = np.where(made.valid[1][:, None], made.keypoints_px[1, :, k], np.nan)
            np.testing.assert_array_equal(series.data[:], expected)
            np.testing.assert_allclose(series.timestamps[:], np.array(FRAMES) / FPS)
            assert np.isnan(series.confidence[:]).all()
            assert "NaN where the result does not hold detections" in series.confidence_definition


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


def test_error_bars_and_flags(tmp_path):
    """Standard deviations in the order of the skeleton, and an interval for each range of frames with one flag."""
    shape = (len(TRACKS), len(FRAMES), BIRD.num_keypoints)
    variance = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    covariance = variance[..., None, None] * np.diag([1, 4]).astype(np.float32)
    doubts = np.zeros(shape[:2], np.int8)
    doubts[1] = [1, -1, -1, 4, 12]
    made = write_result(
        tmp_path / "result", video="/films/clip.mp4", **error_bars(shape, keypoints_px_cov=covariance), doubts=doubts
    )
    jaxfit.export_result(tmp_path / "result", "nwb", tmp_path / "nwb")
    path = tmp_path / "nwb" / "bird_7.nwb"
    assert not pynwb.validate(path=path)
    with pynwb.NWBHDF5IO(path, "r") as io:
        file = io.read()
        behaviour = file.processing["behavior"]
        sd = behaviour["keypoints_sd"]
        expected = np.sqrt(variance[1])[..., None] * [1, 2]
        expected[~made.valid[1]] = np.nan
        np.testing.assert_allclose(sd.data[:], expected, rtol=1e-6)
        np.testing.assert_allclose(sd.timestamps[:], np.array(FRAMES) / FPS)
        assert sd.unit == "pixels"
        assert "networks these values are too small" in sd.description
        rows = file.intervals["pose_flags"].to_dataframe()
        assert rows.flag.tolist() == ["contradicted", "unsure"]
        assert rows.doubts.tolist() == [
            "keypoints far from the pose",
            "a second pose fits almost as well; error bars above 10 % of the length",
        ]
        step = 2 / FPS  # every second frame was used
        np.testing.assert_allclose(rows.start_time, [10 / FPS, 18 / FPS])
        np.testing.assert_allclose(rows.stop_time, [10 / FPS + step, 20 / FPS + step])


def test_results_without_error_bars_and_flags_have_neither(tmp_path):
    write_result(tmp_path / "result", video="/films/clip.mp4")
    jaxfit.export_result(tmp_path / "result", "nwb", tmp_path / "nwb")
    with pynwb.NWBHDF5IO(tmp_path / "nwb" / "bird_3.nwb", "r") as io:
        file = io.read()
        assert file.intervals is None or "pose_flags" not in file.intervals
        assert "keypoints_sd" not in file.processing["behavior"].data_interfaces
