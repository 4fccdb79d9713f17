"""Writing videos: frames survive a round trip, bytes are reproducible, and no incomplete file remains."""

import logging
import re

import av
import cv2
import numpy as np
import pytest
from av.video.frame import PictureType
from support.films import COUNT, FPS, SIZE, frames, write

from jaxfit.foundation.errors import InputError
from jaxfit.video import writer as writer_module
from jaxfit.video.reader import VideoInfo, probe_video, read_frames
from jaxfit.video.writer import VideoWriter


@pytest.mark.parametrize(
    ("name", "codec", "written"),
    [("a.mp4", "auto", "h264"), ("a.mp4", "vp9", "vp9"), ("a.MP4", "mpeg4", "mpeg4"), ("a.webm", "auto", "vp9")],
)
def test_round_trip(tmp_path, name, codec, written):
    path = tmp_path / "new" / name
    writer = write(path, codec)
    assert (writer.codec, writer.fallback, writer.frames) == (written, False, COUNT)
    known = None if name == "a.webm" else COUNT
    assert probe_video(path) == VideoInfo(known, FPS, SIZE)
    read = list(read_frames(path))
    assert [frame.index for frame in read] == list(range(COUNT))
    for (_, frame, _), sent in zip(read, frames(), strict=True):
        assert frame.shape == sent.shape
        assert frame.dtype == np.uint8
        error = frame.astype(int) - sent
        assert np.abs(error).mean() < 12
        assert np.abs(error.mean((0, 1))).max() < 3  # no tint
        for channel in range(3):  # away from the patch's edges
            patch = frame[12:20, 16 * channel + 4 : 16 * channel + 12].mean((0, 1))
            np.testing.assert_allclose(patch, 255 * np.eye(3)[channel], atol=25)


@pytest.mark.parametrize(
    ("name", "codec"), [("a.mp4", "auto"), ("a.mp4", "vp9"), ("a.mp4", "mpeg4"), ("a.webm", "auto")]
)
def test_the_same_bytes_every_time(tmp_path, name, codec):
    """At this size x264's own defaults differ in every third run."""
    contents = set()
    for _ in range(4):
        write(tmp_path / name, codec, size=(320, 240), count=12)
        contents.add((tmp_path / name).read_bytes())
    assert len(contents) == 1


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "auto"), ("a.mp4", "vp9"), ("a.mp4", "mpeg4")])
def test_films_without_frames_that_depend_on_later_ones(tmp_path, name, codec):
    rng = np.random.default_rng(0)
    picture = cv2.resize(rng.integers(0, 256, (20, 30, 3), np.uint8), (320, 240))
    with VideoWriter(tmp_path / name, (320, 240), FPS, codec, b_frames=False) as writer:
        for i in range(12):
            writer.write(np.roll(picture, 3 * i, axis=1))
    with av.open(str(tmp_path / name)) as container:
        assert PictureType.B not in {frame.pict_type for frame in container.decode(video=0)}


def test_a_keyframe_every_second_and_the_index_first(tmp_path):
    write(tmp_path / "a.mp4")
    with av.open(str(tmp_path / "a.mp4")) as container:
        keys = [i for i, frame in enumerate(container.decode(video=0)) if frame.key_frame]
    assert np.diff([*keys, COUNT]).max() <= FPS
    content = (tmp_path / "a.mp4").read_bytes()
    assert 0 < content.find(b"moov") < content.find(b"mdat")


def test_odd_sides_are_padded(tmp_path):
    writer = write(tmp_path / "a.mp4", size=(63, 47), count=2)
    assert (writer.size_px, writer.written_size_px) == ((63, 47), (64, 48))
    frame = next(iter(read_frames(tmp_path / "a.mp4"))).picture
    assert frame.shape == (48, 64, 3)
    sent = next(frames((63, 47), 1)).astype(int)
    assert np.abs(frame[:47, :63] - sent).mean() < 12
    assert np.abs(frame[:47, 63] - sent[:, -1]).mean() < 12


def test_what_an_encoder_cannot_do_is_one_clear_error(tmp_path):
    """MPEG-4 has no time base for 120000/1001 frames/s, the rate of an action camera."""
    expected = pytest.raises(InputError, match=r"cannot be encoded as mpeg4, .* at 119\.88 frames/s.*another codec")
    with expected, VideoWriter(tmp_path / "a.mp4", SIZE, 120000 / 1001, "mpeg4") as writer:
        writer.write(next(frames()))
    assert not list(tmp_path.iterdir())


def test_television_rates_are_exact(tmp_path):
    with VideoWriter(tmp_path / "a.mp4", SIZE, 30000 / 1001) as writer:
        writer.write(next(frames()))
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert container.streams.video[0].average_rate == writer.fps
    assert (writer.fps.numerator, writer.fps.denominator) == (30000, 1001)


@pytest.mark.parametrize(
    ("missing", "requested", "written", "note"),
    [
        (("libx264",), "auto", "vp9", "PyAV has no h264 encoder, written as vp9$"),
        (("libx264", "libvpx-vp9"), "auto", "mpeg4", "browsers do not"),
        (("mpeg4",), "mpeg4", "h264", "PyAV has no mpeg4 encoder, written as h264$"),
    ],
)
def test_a_fallback_codec_is_reported(tmp_path, monkeypatch, caplog, missing, requested, written, note):
    class WithoutSome:
        @staticmethod
        def Codec(name, mode):  # noqa: N802
            return av.Codec("no such codec" if name in missing else name, mode)

        def __getattr__(self, name):
            return getattr(av, name)

    monkeypatch.setattr(writer_module, "av", WithoutSome())
    with caplog.at_level(logging.WARNING):
        writer = write(tmp_path / "a.mp4", requested, count=2)
    assert (writer.codec, writer.fallback) == (written, True)
    (record,) = caplog.records
    assert record.getMessage().startswith("a.mp4: ")
    assert re.search(note, record.getMessage())
    assert len(list(read_frames(tmp_path / "a.mp4"))) == 2


def test_a_container_without_an_encoder(tmp_path, monkeypatch):
    monkeypatch.setattr(writer_module, "_has_encoder", lambda codec: False)
    with pytest.raises(InputError, match=r"a\.webm: PyAV has no encoder for vp9"):
        VideoWriter(tmp_path / "a.webm", SIZE, FPS)


def write_and_stop(path):
    with VideoWriter(path, SIZE, FPS) as writer:
        for frame in frames():
            writer.write(frame)
        assert any(".part" in file.name for file in path.parent.iterdir())
        raise KeyboardInterrupt


def test_no_incomplete_video_remains(tmp_path):
    write(tmp_path / "old.mp4", count=3)
    before = (tmp_path / "old.mp4").read_bytes()
    for name in ("old.mp4", "new.mp4", "folder/new.webm"):
        with pytest.raises(KeyboardInterrupt):
            write_and_stop(tmp_path / name)
        with (
            pytest.raises(InputError, match="has no frames and is not written"),
            VideoWriter(tmp_path / name, SIZE, FPS),
        ):
            pass
    assert [file.name for file in tmp_path.rglob("*")] == ["old.mp4"]
    assert (tmp_path / "old.mp4").read_bytes() == before


def test_a_full_disk(tmp_path):
    resource, signal = pytest.importorskip("resource"), pytest.importorskip("signal")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, before[1]))
    try:
        with pytest.raises(InputError, match=r"a\.mp4: cannot be written: File too large"):
            write(tmp_path / "a.mp4", size=(640, 480))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"codec": "h265"}, "codec must be auto or one of h264, vp9, mpeg4, not 'h265'"),
        ({"path": "a.webm", "codec": "h264"}, r"a\.webm: cannot hold the codec h264 \(choose vp9"),
        ({"path": "a.avi"}, r"a\.avi: has no video extension \(end the name in \.mp4 or \.webm"),
        ({"size_px": (0, 4)}, "size_px must be"),
        ({"fps": 0}, "fps must be positive and finite"),
        ({"fps": 1e-9}, "fps must be 1/1001 or more"),
    ],
)
def test_wrong_use(change, message):
    with pytest.raises(ValueError, match=message):
        VideoWriter(**{"path": "a.mp4", "size_px": SIZE, "fps": FPS} | change)


def test_frames_that_do_not_fit(tmp_path):
    writer = VideoWriter(tmp_path / "a.mp4", SIZE, FPS)
    with pytest.raises(ValueError, match="the writer is not open"):
        writer.write(next(frames()))
    for frame in (np.zeros((64, 48, 3), np.uint8), np.zeros((48, 64, 3)), np.zeros((48, 64), np.uint8)):
        with (
            pytest.raises(ValueError, match=r"frame must be uint8 of shape \(48, 64, 3\), not"),
            VideoWriter(tmp_path / "a.mp4", SIZE, FPS) as writer,
        ):
            writer.write(frame)
    (tmp_path / "folder.mp4").mkdir()
    with pytest.raises(InputError, match="is a folder"), VideoWriter(tmp_path / "folder.mp4", SIZE, FPS):
        pass
