"""Reading videos: frame numbers are stable, damage is reported and skipped, and the thread ends."""

import logging

import av
import numpy as np
import pytest
from av.stream import Disposition
from support.films import COUNT, encode, number_in, overwrite, packets, reader_threads, write

from jaxfit.foundation.errors import InputError, counted
from jaxfit.video import decoding
from jaxfit.video.decoding import frame_times
from jaxfit.video.reader import VideoInfo, probe_video, read_frames

KINDS = {
    "b_frames.mp4": {"options": {"bf": "3", "x264-params": "b-pyramid=normal"}},
    "open.mp4": {"options": {"x264-params": "open-gop=1:bframes=3:scenecut=0"}},
    "refresh.mp4": {"options": {"x264-params": "intra-refresh=1"}},
    "hevc.mp4": {"codec": "libx265", "options": {"x265-params": "log-level=error"}},
    "b_frames.mkv": {},
    "vp9.webm": {"codec": "libvpx-vp9", "options": {"deadline": "realtime", "cpu-used": "8"}},
    "plain.avi": {"codec": "mpeg4"},
    "b_frames.avi": {"codec": "mpeg4", "b_frames": 2},
    "h264.avi": {},
    "h264.ts": {},
    "raw.h264": {},
}


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    return {name: encode(folder / name, **kind) for name, kind in KINDS.items()}


@pytest.fixture(autouse=True)
def _warnings(caplog):
    caplog.set_level(logging.WARNING, "jaxfit")


@pytest.fixture
def decoded(monkeypatch):
    """The numbers of the decoded pictures."""
    numbers = []

    def recorded(path, pictures):
        for picture in pictures:
            numbers.append(picture.number)
            yield picture

    monkeypatch.setattr(decoding, "deinterlaced", recorded)
    return numbers


@pytest.mark.parametrize("name", KINDS)
def test_frame_numbers_do_not_depend_on_the_start(films, decoded, caplog, name):
    reader = read_frames(films[name])
    every = list(reader)
    assert [number_in(frame.picture) for frame in every] == [frame.index for frame in every] == list(range(100))
    # FFmpeg gives the first picture of some files the decoding time 0, and B-frames delay its presentation
    first_s = {"b_frames.avi": 1 / 25, "h264.ts": 2 / 25}.get(name, 0)
    times = [frame.time_s for frame in every]
    np.testing.assert_allclose(times, first_s + np.arange(100) / 25)
    assert frame_times(films[name], 1000).tolist() == times
    assert frame_times(films[name], 30).tolist() == times[:30]
    assert reader.info == VideoInfo(100 if name.endswith(("mp4", "avi")) else None, 25, (128, 80))
    for start in (1, 20, 58, 77, 99):
        decoded.clear()
        some = list(read_frames(films[name], start, start + 5, 2))
        assert [frame.index for frame in some] == list(range(100))[start : start + 5 : 2]
        for frame in some:
            np.testing.assert_array_equal(frame.picture, every[frame.index].picture)
            assert frame.time_s == every[frame.index].time_s
        if start > 75 and name.endswith(("mp4", "mkv", "webm")):
            assert 0 < len(decoded) < 75
    assert caplog.messages == []


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_a_variable_frame_rate(tmp_path, name):
    """A recording may begin after 0, and frames may have any distance."""
    ticks = 132 + np.cumsum(np.random.default_rng(3).integers(1, 9, 100))
    ticks[50:] += 200
    encode(tmp_path / name, ticks=ticks.tolist())
    for start in (0, 49, 50, 83):
        read = list(read_frames(tmp_path / name, start))
        numbers = [frame.index for frame in read]
        assert [number_in(frame.picture) for frame in read] == numbers == list(range(start, 100))
        np.testing.assert_allclose([frame.time_s for frame in read], ticks[start:] / 100, atol=1e-3)
    assert frame_times(tmp_path / name, 100)[83:].tolist() == [frame.time_s for frame in read]


@pytest.mark.parametrize("name", ["b_frames.mp4", "open.mp4", "b_frames.mkv", "plain.avi", "h264.avi"])
@pytest.mark.parametrize("hit", [40, 47, 53])
def test_a_damaged_packet(tmp_path, films, caplog, name, hit):
    """Damaged frames are reported up to the next keyframe; all other frames keep their numbers and pixels."""
    (tmp_path / name).write_bytes(films[name].read_bytes())
    position, size, _ = packets(films[name])[hit]
    overwrite(tmp_path / name, position + size // 3, size // 2)
    whole = {frame.index: frame.picture for frame in read_frames(films[name])}
    reader = read_frames(tmp_path / name)
    given = {frame.index: frame.picture for frame in reader}
    assert sorted([*given, *reader.damaged]) == list(range(100))
    assert all(36 <= i < 60 for i in reader.damaged)
    # a picture that is shown just before the damage, but decoded after it, may repeat the damage
    wrong = [i for i, picture in given.items() if (picture != whole[i]).any()]
    assert set(wrong) <= set(range(hit - 4, hit + 5))
    late = read_frames(tmp_path / name, 45, 70, 5)
    assert sorted([*(frame.index for frame in late), *late.damaged]) == [45, 50, 55, 60, 65]
    assert late.damaged == [i for i in reader.damaged if i in (45, 50, 55)]
    assert any(abs(i - hit) <= 4 for i in reader.damaged)
    assert f"{name}: {counted(len(reader.damaged), 'damaged frame')} skipped (" in caplog.messages[0]


def test_a_stream_that_begins_between_keyframes(tmp_path, films):
    """Frame 0 is the first picture that can be decoded, as in OpenCV; players show this picture first."""
    known = packets(films["h264.ts"])
    content = films["h264.ts"].read_bytes()
    (tmp_path / "a.ts").write_bytes(content[: 188 * 3] + content[known[10][0] :])
    reader = read_frames(tmp_path / "a.ts")
    read = list(reader)
    assert [(frame.index, number_in(frame.picture)) for frame in read] == [(i, i + 20) for i in range(80)]
    assert reader.damaged == []
    assert frame_times(tmp_path / "a.ts", 5).tolist() == [frame.time_s for frame in read[:5]]
    assert number_in(next(iter(read_frames(tmp_path / "a.ts", 30))).picture) == 50


@pytest.mark.parametrize("name", ["h264.ts", "b_frames.mpg"])
def test_joined_recordings_have_one_clock(tmp_path, films, name):
    """The clock of each recording begins at 0; the numbers and the times of the frames rise over both."""
    if name not in films:
        films[name] = encode(tmp_path / "one.mpg", "mpeg2video", b_frames=2)
    (tmp_path / name).write_bytes(films[name].read_bytes() * 2)
    reader = read_frames(tmp_path / name)
    read = list(reader)
    assert [number_in(frame.picture) for frame in read] == [*range(100), *range(100)]
    assert reader.damaged == []
    np.testing.assert_allclose(np.diff([frame.time_s for frame in read]), 1 / 25, atol=0.05)
    assert (np.diff([frame.time_s for frame in read]) > 0).all()
    assert frame_times(tmp_path / name, 1000).tolist() == [frame.time_s for frame in read]


def test_a_stream_without_a_rate(tmp_path, films, caplog):
    """FFmpeg assumes 25 frames per second for a raw stream; the header of H.264 has the rate, that of MJPEG has not."""
    assert probe_video(encode(tmp_path / "a.h264", rate=50, count=10)).fps == 50
    encode(tmp_path / "a.mjpeg", "mjpeg", count=10)
    assert probe_video(tmp_path / "a.mjpeg").fps is None
    assert [frame.time_s for frame in read_frames(tmp_path / "a.mjpeg")] == [None] * 10
    assert np.isnan(frame_times(tmp_path / "a.mjpeg", 99)).all()
    assert "states no frame rate, so the times of its frames are unknown" in caplog.text


@pytest.mark.parametrize("name", ["front.mp4", "plain.avi", "vp9.webm"])
def test_a_truncated_file(tmp_path, films, caplog, name):
    path = films.get(name, tmp_path / name)
    if path.parent == tmp_path:  # other MP4 files have their index at the end
        write(path, count=100)
    position, size, _ = packets(path)[70]
    (tmp_path / name).write_bytes(path.read_bytes()[: position + size // 2])
    read = [frame.index for frame in read_frames(tmp_path / name)]
    assert read == list(range(len(read)))
    assert 60 < len(read) <= 71
    assert sum("ends after" in text for text in caplog.messages) == 1


def test_a_file_truncated_before_its_frames(tmp_path):
    write(tmp_path / "a.mp4")
    whole = (tmp_path / "a.mp4").read_bytes()
    sizes = {60: "(not a readable|has no) video", whole.find(b"mdat") + 8: "no frame can be decoded"}
    for size, problem in sizes.items():
        (tmp_path / "c.mp4").write_bytes(whole[:size])
        with pytest.raises(InputError, match=rf"c\.mp4: .*{problem}"):
            list(read_frames(tmp_path / "c.mp4"))
    assert not reader_threads()


def test_some_frames(tmp_path):
    write(tmp_path / "a.mp4")
    every = list(read_frames(tmp_path / "a.mp4"))
    for start, stop, step in ((0, 7, 3), (20, 1000, 4), (40, None, 1), (3, 3, 1), (29, None, 5)):
        some = list(read_frames(tmp_path / "a.mp4", start, stop, step))
        assert [frame.index for frame in some] == list(range(COUNT))[start:stop:step]
        for frame in some:
            np.testing.assert_array_equal(frame.picture, every[frame.index].picture)
    for wrong in ((-1, None, 1), (0, -1, 1), (0, None, 0)):
        with pytest.raises(ValueError, match="step 1 or more"):
            read_frames(tmp_path / "a.mp4", *wrong)
    with pytest.raises(ValueError, match="fps must be positive and finite"):
        read_frames(tmp_path, fps=0)
    with pytest.raises(InputError, match="which has its own frame rate"):
        read_frames(tmp_path / "a.mp4", fps=25)


def test_files_that_are_not_videos(tmp_path):
    with pytest.raises(InputError, match=r"absent\.mp4: does not exist"):
        read_frames(tmp_path / "absent.mp4")
    with pytest.raises(InputError, match="has no images"):
        read_frames(tmp_path)
    playlist = "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n"
    for name, content in (("a.mp4", "no video at all\n" * 500), ("b.mp4", ""), ("a.m3u8", playlist)):
        (tmp_path / name).write_text(content)
        with pytest.raises(InputError, match="is not a readable video"):
            probe_video(tmp_path / name)
        with pytest.raises(InputError, match="is not a readable video"):
            frame_times(tmp_path / name, 5)


@pytest.mark.parametrize("suffix", ["mp4", "mkv"])
@pytest.mark.parametrize("default", [0, 1])
def test_the_default_of_several_streams(tmp_path, caplog, suffix, default):
    """The line names the stream, because OpenCV reads the first one in any case."""
    path = tmp_path / f"two.{suffix}"
    with av.open(str(path), "w") as container:
        streams = [container.add_stream("mpeg4", rate=25) for _ in range(2)]
        for i, stream in enumerate(streams):
            stream.width, stream.height, stream.pix_fmt = 64 + 32 * i, 48, "yuv420p"
            stream.disposition = Disposition.default if i == default else Disposition(0)
        for number in range(6):
            for i, stream in enumerate(streams):
                picture = np.full((48, 64 + 32 * i, 3), 40 * number, np.uint8)
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, "bgr24")))
        for stream in streams:
            container.mux(stream.encode(None))
    frames = list(read_frames(path))
    assert probe_video(path).size_px == frames[5].picture.shape[1::-1] == (64 + 32 * default, 48)
    assert len(frames) == 6
    (line,) = caplog.messages
    assert line.startswith(f"{path}: has 2 video streams (64×48, 96×48); number {default + 1} is read")
    assert ("OpenCV take number 1" in line) == (default == 1)


@pytest.mark.parametrize("name", ["sound.wav", "sound.mkv"])
def test_a_file_with_only_sound(tmp_path, name):
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream("pcm_s16le" if name.endswith("wav") else "aac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.int16), format="s16", layout="mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(InputError, match="has no video stream"):
        read_frames(tmp_path / name)
