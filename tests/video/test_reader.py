"""Reading videos: frame numbers are stable, damage is reported and skipped, and the thread ends."""

import logging

import av
import cv2
import numpy as np
import pytest
from support.films import COUNT, SIZE, encode, frames, number_in, numbered, overwrite, packets, reader_threads, write

from jaxfit.foundation.errors import InputError
from jaxfit.video import packets as packet_reading
from jaxfit.video.pictures import image_files
from jaxfit.video.reader import Frame, VideoInfo, probe_video, read_frames

KINDS = {
    "b_frames.mp4": {"options": {"bf": "3", "x264-params": "b-pyramid=normal"}},
    "open.mp4": {"options": {"x264-params": "open-gop=1:bframes=3:scenecut=0"}},
    "refresh.mp4": {"options": {"x264-params": "intra-refresh=1"}},
    "b_frames.mkv": {},
    "vp9.webm": {"codec": "libvpx-vp9", "options": {"deadline": "realtime", "cpu-used": "8"}},
    "plain.avi": {"codec": "mpeg4"},
    "b_frames.avi": {"codec": "mpeg4", "b_frames": 2},
    "h264.avi": {},
}


@pytest.fixture(scope="module")
def films(tmp_path_factory):
    folder = tmp_path_factory.mktemp("films")
    return {name: encode(folder / name, **kind) for name, kind in KINDS.items()}


@pytest.fixture
def shown(monkeypatch):
    """The count of decoded pictures."""
    count = []

    class Counting(packet_reading.Timeline):
        def show(self, picture):
            count.append(1)
            super().show(picture)

    monkeypatch.setattr(packet_reading, "Timeline", Counting)
    return count


@pytest.fixture
def warnings_so_far(caplog):
    """The messages of the warnings so far."""
    caplog.set_level(logging.WARNING, "jaxfit")
    return lambda: [record.getMessage() for record in caplog.records]


@pytest.mark.parametrize("name", KINDS)
def test_frame_numbers_do_not_depend_on_the_start(films, shown, warnings_so_far, name):
    reader = read_frames(films[name])
    every = list(reader)
    assert [number_in(frame.picture) for frame in every] == [frame.index for frame in every] == list(range(100))
    # FFmpeg gives the first picture of an AVI file the decoding time 0, and B-frames delay its presentation
    first_s = 1 / 25 if name == "b_frames.avi" else 0
    np.testing.assert_allclose([frame.time_s for frame in every], first_s + np.arange(100) / 25)
    assert reader.info == VideoInfo(None if name.endswith(("mkv", "webm")) else 100, 25, (128, 80))
    for start in (1, 19, 20, 21, 58, 77, 81, 99):
        shown.clear()
        some = list(read_frames(films[name], start, start + 5, 2))
        assert [frame.index for frame in some] == list(range(100))[start : start + 5 : 2]
        for frame in some:
            np.testing.assert_array_equal(frame.picture, every[frame.index].picture)
            assert frame.time_s == every[frame.index].time_s
        if start > 75 and not name.endswith("avi"):  # AVI has no time stamps to seek by
            assert 0 < len(shown) < 75
    assert warnings_so_far() == []


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_a_variable_frame_rate(tmp_path, name):
    ticks = np.cumsum(np.random.default_rng(3).integers(1, 9, 100)) - 1
    ticks[50:] += 200
    encode(tmp_path / name, ticks=ticks.tolist())
    for start in (0, 49, 50, 83):
        read = list(read_frames(tmp_path / name, start))
        assert (
            [number_in(frame.picture) for frame in read] == [frame.index for frame in read] == list(range(start, 100))
        )
        np.testing.assert_allclose([frame.time_s for frame in read], ticks[start:] / 100, atol=1e-3)
    assert not read_frames(tmp_path / name).damaged


@pytest.mark.parametrize("name", ["b_frames.mp4", "open.mp4", "b_frames.mkv", "plain.avi", "b_frames.avi", "h264.avi"])
@pytest.mark.parametrize("hit", [40, 47, 53])
def test_a_damaged_packet(tmp_path, films, warnings_so_far, name, hit):
    """Every returned frame is exact, every other frame is reported, and all frames from the next keyframe on return."""
    (tmp_path / name).write_bytes(films[name].read_bytes())
    position, size, _ = packets(films[name])[hit]
    overwrite(tmp_path / name, position + size // 3, size // 2)
    whole = {frame.index: frame.picture for frame in read_frames(films[name])}
    reader = read_frames(tmp_path / name)
    given = {frame.index: frame.picture for frame in reader}
    assert sorted([*given, *reader.damaged]) == list(range(100))
    wrong = [i for i, picture in given.items() if (picture != whole[i]).any()]
    if name == "h264.avi":  # without time stamps pictures reordered about the damage cannot be warnings_so_far
        assert set(wrong) <= set(range(hit - 4, hit + 5))
    else:
        assert wrong == []
    assert any(abs(i - hit) <= 4 for i in reader.damaged)
    assert all(36 <= i < 60 for i in reader.damaged)
    (warning,) = warnings_so_far()
    assert f"{name}: {len(reader.damaged)} damaged frames are skipped (" in warning
    late = read_frames(tmp_path / name, 45, 70, 5)
    assert sorted([*(frame.index for frame in late), *late.damaged]) == [45, 50, 55, 60, 65]
    assert late.damaged == [i for i in reader.damaged if i in (45, 50, 55)]


@pytest.mark.parametrize("name", ["plain.avi", "b_frames.avi", "h264.avi", "b_frames.mkv", "vp9.webm"])
def test_lost_packets(tmp_path, films, warnings_so_far, name):
    """Damage hides packets from the container. Later numbers are those of the undamaged file."""
    (tmp_path / name).write_bytes(films[name].read_bytes())
    known = packets(films[name])
    begin = next(i for i in range(36, 60) if known[i][2])
    overwrite(tmp_path / name, known[begin][0] - 12, known[begin + 8][0] - known[begin][0])
    reader = read_frames(tmp_path / name)
    given = list(reader)
    assert [number_in(frame.picture) for frame in given] == [frame.index for frame in given]
    assert {*range(begin - 4), *range(60, 100)} <= {frame.index for frame in given}
    assert set(reader.damaged) >= set(range(begin + 1, begin + 17))
    assert len(warnings_so_far()) == 1


def test_lost_packets_of_uneven_time(tmp_path):
    """The number of lost packets is unknown: counting continues without a gap, and the times stay correct."""
    ticks = np.cumsum(np.random.default_rng(3).integers(1, 9, 100)) - 1
    encode(tmp_path / "a.mkv", ticks=ticks.tolist())
    known = packets(tmp_path / "a.mkv")
    overwrite(tmp_path / "a.mkv", known[40][0] - 12, known[48][0] - known[40][0])
    given = list(read_frames(tmp_path / "a.mkv"))
    last = given[-1]
    assert (last.index < 99, number_in(last.picture)) == (True, 99)
    np.testing.assert_allclose(last.time_s, ticks[99] / 100, atol=1e-3)


@pytest.mark.parametrize("name", ["b_frames.mp4", "plain.avi", "vp9.webm"])
def test_a_truncated_file(tmp_path, films, warnings_so_far, name):
    position, size, _ = packets(films[name])[70]
    content = films[name].read_bytes()
    if name.endswith("mp4"):  # its index stands at the end unless asked for otherwise
        write(tmp_path / "front.mp4", count=100)
        content = (tmp_path / "front.mp4").read_bytes()
        position, size, _ = packets(tmp_path / "front.mp4")[70]
    (tmp_path / name).write_bytes(content[: position + size // 2])
    reader = read_frames(tmp_path / name)
    read = [frame.index for frame in reader]
    assert read == list(range(len(read)))
    assert 60 < len(read) <= 71
    assert sum("ends after" in text for text in warnings_so_far()) == 1


def test_a_file_truncated_before_its_frames(tmp_path):
    write(tmp_path / "a.mp4")
    whole = (tmp_path / "a.mp4").read_bytes()
    for size, problem in (
        (60, "(not a readable|has no) video"),
        (whole.find(b"mdat") + 8, "no frame can be decoded"),
    ):
        (tmp_path / "c.mp4").write_bytes(whole[:size])
        with pytest.raises(InputError, match=rf"c\.mp4: .*{problem}"):
            list(read_frames(tmp_path / "c.mp4"))
    assert not reader_threads()


def test_some_frames(tmp_path):
    write(tmp_path / "a.mp4")
    every = list(read_frames(tmp_path / "a.mp4"))
    for start, stop, step in ((5, None, 1), (0, 7, 3), (20, 1000, 4), (40, None, 1), (3, 3, 1), (29, None, 5)):
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


def test_a_folder_of_images(tmp_path, warnings_so_far):
    for i, frame in enumerate(frames(count=12)):
        cv2.imwrite(str(tmp_path / f"frame{i}.png"), frame)  # 10 stands before 2 in plain order
    (tmp_path / "notes.txt").write_text("none of these")
    assert probe_video(tmp_path) == VideoInfo(12, None, SIZE)
    read = list(read_frames(tmp_path, 1, None, 2))
    assert [frame.index for frame in read] == [1, 3, 5, 7, 9, 11]
    assert {frame.time_s for frame in read} == {None}
    for frame, sent in zip(read, list(frames(count=12))[1::2], strict=True):
        np.testing.assert_array_equal(frame.picture, sent)
    assert [frame.time_s for frame in read_frames(tmp_path, 4, fps=4)] == [1 + i / 4 for i in range(8)]
    assert list(read_frames(tmp_path, 50)) == []
    assert warnings_so_far() == []


def test_images_that_cannot_be_read(tmp_path, warnings_so_far):
    for i, frame in enumerate(frames(count=12)):
        cv2.imwrite(str(tmp_path / f"{i}.png"), frame)
    for i, content in ((0, b""), (3, b"no image"), (4, (tmp_path / "4.png").read_bytes()[:40])):
        (tmp_path / f"{i}.png").write_bytes(content)
    reader = read_frames(tmp_path, fps=2)
    assert reader.info == VideoInfo(12, 2, SIZE)
    assert [(frame.index, frame.time_s) for frame in reader] == [(i, i / 2) for i in (1, 2, *range(5, 12))]
    assert reader.damaged == [0, 3, 4]
    assert warnings_so_far() == [f"{tmp_path}: 3 damaged frames are skipped (0, 3–4)"]
    cv2.imwrite(str(tmp_path / "7.png"), np.zeros((10, 20, 3), np.uint8))
    with pytest.raises(InputError, match=r"7\.png: is 20×10, but the images before are 64×48"):
        list(reader)
    for file in tmp_path.iterdir():
        file.write_bytes(b"")
    with pytest.raises(InputError, match="has no readable image"):
        read_frames(tmp_path)


def test_files_that_macos_writes_beside_pictures_are_no_frames(tmp_path):
    cv2.imwrite(str(tmp_path / "img0.png"), np.zeros((8, 8, 3), np.uint8))
    (tmp_path / "._img0.png").write_bytes(b"Mac OS X")
    assert [file.name for file in image_files(tmp_path)] == ["img0.png"]


def test_files_that_are_not_videos(tmp_path):
    with pytest.raises(InputError, match=r"absent\.mp4: does not exist"):
        read_frames(tmp_path / "absent.mp4")
    with pytest.raises(InputError, match="has no images"):
        read_frames(tmp_path)
    for name, content in (("a.mp4", b"no video at all\n" * 500), ("b.mp4", b""), ("c.txt", b"some words")):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(InputError, match="is not a readable video"):
            read_frames(tmp_path / name)


@pytest.mark.parametrize("name", ["sound.wav", "sound.mp4", "sound.mkv"])
def test_a_file_with_only_sound(tmp_path, name):
    with av.open(str(tmp_path / name), "w") as container:
        stream = container.add_stream("pcm_s16le" if name.endswith("wav") else "aac", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 8000), np.int16), format="s16", layout="mono")
        sound.rate = 8000
        container.mux(stream.encode(sound))
        container.mux(stream.encode(None))
    with pytest.raises(InputError, match="has no video stream"):
        read_frames(tmp_path / name)


def test_a_playlist_opens_no_network_address(tmp_path):
    text = "#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\nhttp://127.0.0.1:9/a.ts\n#EXT-X-ENDLIST\n"
    (tmp_path / "a.m3u8").write_text(text)
    with pytest.raises(InputError):
        list(read_frames(tmp_path / "a.m3u8"))


def test_number_in_reads_the_number_of_a_picture():
    assert [number_in(numbered(i)) for i in range(256)] == list(range(256))
    assert Frame(1, numbered(1), None).index == 1
