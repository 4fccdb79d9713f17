"""The record of an unfinished reconstruction: the content of the video, read once with progress."""

import hashlib
from contextlib import contextmanager

import cv2
import numpy as np

from jaxfit import pipeline
from jaxfit.config.perception import TrackConfig
from jaxfit.pipeline import tracking_record


def record(video, seen=None):
    @contextmanager
    def progress(name, total):
        seen.append((name, total))
        yield lambda done, _note: seen.append(done)

    given = (progress,) if seen is not None else ()
    return tracking_record(TrackConfig(), video, {"keypoints": {"k.onnx": "0"}}, *given)


def test_the_content_of_a_file_counts_and_its_bytes_are_progress(tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "_BLOCK_BYTES", 400)
    content = np.random.default_rng(0).bytes(1000)
    (tmp_path / "a.mp4").write_bytes(content)
    seen = []
    made = record(tmp_path / "a.mp4", seen)
    assert made["video"] == {"name": "a.mp4", "content": hashlib.sha256(content).hexdigest()}
    assert made["networks"] == {"keypoints": {"k.onnx": "0"}}
    assert seen == [("Checking the video", 1000), 400, 400, 200]


def test_names_and_contents_of_a_folder_count(tmp_path):
    for t in range(3):
        cv2.imwrite(str(tmp_path / f"{t}.png"), np.full((4, 4, 3), t, np.uint8))
    before = record(tmp_path)["video"]["content"]
    assert record(tmp_path)["video"]["content"] == before
    (tmp_path / "2.png").rename(tmp_path / "5.png")
    renamed = record(tmp_path)["video"]["content"]
    (tmp_path / "5.png").rename(tmp_path / "2.png")
    cv2.imwrite(str(tmp_path / "1.png"), np.full((4, 4, 3), 9, np.uint8))
    assert len({before, renamed, record(tmp_path)["video"]["content"]}) == 3
