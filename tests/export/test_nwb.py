"""NWB files: one subject a file, valid by pynwb, and equal to the result."""

import numpy as np
import pytest
from support.exported import FPS, FRAMES, write_result

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
