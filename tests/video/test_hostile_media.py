"""Damaged and hostile videos and pictures end in frames, skipped frames or one InputError."""

import os
import struct
import zlib
from contextlib import suppress
from fractions import Fraction

import av
import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.films import encode, frames
from support.hostile import Isolated, many_examples
from support.mutations import damaged_bytes

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import PICTURE_SCANS, VIDEO_GAP_FRAMES
from jaxfit.video.packets import Timeline
from jaxfit.video.pictures import picture_size, read_picture
from jaxfit.video.reader import probe_video, read_frames

PICTURE = next(frames(count=1))
SUFFIXES = (".png", ".jpg", ".bmp", ".tiff", ".webp")


def coded(suffix, picture=PICTURE, settings=()):
    return cv2.imencode(suffix, picture, settings)[1].tobytes()


def png(width, height, depth=8, colours=2, data=b"", kind=b"IHDR"):
    def chunk(name, content):
        return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))

    header = chunk(kind, struct.pack(">IIBBBBB", width, height, depth, colours, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", data) + chunk(b"IEND", b"")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_pictures_are_those_of_opencv(tmp_path, suffix):
    settings = {"": (), "progressive": (cv2.IMWRITE_JPEG_PROGRESSIVE, 1)}
    pictures = {"colour": PICTURE, "grey": PICTURE[..., 0], "deep": PICTURE.astype(np.uint16) * 257}
    for name, picture in pictures.items():
        if name == "deep" and suffix not in (".png", ".tiff"):
            continue
        for setting in settings.values() if suffix == ".jpg" else [()]:
            file = tmp_path / f"{name}{suffix}"
            file.write_bytes(coded(suffix, picture, setting))
            assert picture_size(file.read_bytes()) == PICTURE.shape[1::-1]
            np.testing.assert_array_equal(read_picture(file), cv2.imread(str(file)))


def test_a_picture_is_turned_by_its_exif_data(tmp_path):
    content = coded(".jpg")
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    turned = content[:2] + b"\xff\xe1" + struct.pack(">H", 2 + len(exif)) + exif + content[2:]
    (tmp_path / "a.jpg").write_bytes(turned)
    assert read_picture(tmp_path / "a.jpg").shape[:2] == PICTURE.shape[1::-1]
    np.testing.assert_array_equal(read_picture(tmp_path / "a.jpg"), cv2.imread(str(tmp_path / "a.jpg")))


def test_names_that_are_not_utf8(tmp_path):
    folder = tmp_path / os.fsdecode(b"\xc5land")
    folder.mkdir()
    for name in (b"\xc51.png", b"\xc510.png", b"\xc52.png"):
        (folder / os.fsdecode(name)).write_bytes(coded(".png"))
    assert [frame.index for frame in read_frames(folder)] == [0, 1, 2]
    film = encode(tmp_path / "a.mp4", count=3).rename(tmp_path / os.fsdecode(b"\xc5.mp4"))
    assert len(list(read_frames(film))) == 3


def test_things_that_are_not_pictures(tmp_path):
    """Pipes, cyclic links, folders, bombs and other formats are damaged frames, and no decoder sees them."""
    jpeg = bytearray(coded(".jpg"))
    at = jpeg.find(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = b"\xff" * 4
    scan = coded(".jpg", PICTURE, (cv2.IMWRITE_JPEG_PROGRESSIVE, 1))
    begin = scan.find(b"\xff\xda")
    scans = scan[:begin] + scan[begin : scan.find(b"\xff", begin + 14)] * (PICTURE_SCANS + 1) + b"\xff\xd9"
    bombs = {
        "0.png": png(100_000, 100_000, data=zlib.compress(bytes(1000))),
        "1.png": png(16_000, 16_000, 16, 6, zlib.compress(bytes(1000))),
        "2.png": png(2**31, 0),
        "3.jpg": bytes(jpeg),
        "4.jpg": scans,
        "5.bmp": coded(".bmp").replace(struct.pack("<ii", 64, 48), struct.pack("<ii", 60_000, -60_000)),
        "6.tiff": coded(".tiff").replace(struct.pack("<HHII", 256, 3, 1, 64), struct.pack("<HHII", 256, 4, 1, 2**31)),
        "7.webp": b"RIFF\0\0\0\0WEBPVP8X\n\0\0\0\0\0\0\0" + b"\xff" * 6,
        "8.png": b"P6 64 48 255\n" + PICTURE.tobytes(),
        "9.png": b"",
    }
    for name, content in bombs.items():
        (tmp_path / name).write_bytes(content)
        assert read_picture(tmp_path / name) is None
    os.mkfifo(tmp_path / "10.png")
    (tmp_path / "11.png").symlink_to("11.png")
    (tmp_path / "12.png").mkdir()
    with (tmp_path / "13.png").open("wb") as file:
        file.truncate(1 << 40)
    (tmp_path / "14.png").write_bytes(coded(".png"))
    reader = read_frames(tmp_path)
    assert [frame.index for frame in reader] == [14]
    assert reader.damaged == list(range(14))
    for path in ("10.png", "11.png", "13.png/a.mp4", "x" * 300 + ".mp4"):
        with pytest.raises(InputError):
            probe_video(tmp_path / path)


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    return encode(tmp_path_factory.mktemp("film") / "a.mp4", "mpeg4", count=6, gop=3)


def changed(film, box, offset, content):
    """Return the bytes of a film with a changed field of a box."""
    whole = film.read_bytes()
    at = whole.rfind(box) + offset
    return whole[:at] + content + whole[at + len(content) :]


@pytest.mark.parametrize(
    ("box", "offset", "content", "fps"),
    [
        (b"stts", 16, struct.pack(">I", 2**31 - 1), None),
        (b"mdhd", 16, struct.pack(">I", 2**31 - 1), None),
        (b"mdhd", 16, bytes(4), 2**-9),
        (b"mvhd", 16, b"\xff" * 8, 25),
        (b"udta", 4, b"\xc5" * 30, 25),
    ],
)
def test_absurd_rates_and_durations(film, tmp_path, box, offset, content, fps):
    (tmp_path / "a.mp4").write_bytes(changed(film, box, offset, content))
    assert probe_video(tmp_path / "a.mp4").fps == fps
    with suppress(InputError):
        list(read_frames(tmp_path / "a.mp4"))


def test_metadata_that_are_not_utf8(tmp_path):
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        container.metadata["title"] = "z" * 20
        stream = container.add_stream("mpeg4", rate=25)
        stream.width, stream.height = 64, 48
        container.mux(stream.encode(av.VideoFrame.from_ndarray(PICTURE, format="bgr24")))
        container.mux(stream.encode(None))
    content = (tmp_path / "a.mp4").read_bytes()
    (tmp_path / "a.mp4").write_bytes(content.replace(b"z" * 20, b"\xc5" * 20))
    assert len(list(read_frames(tmp_path / "a.mp4"))) == 1


def test_pictures_that_are_too_large_or_change_their_size(tmp_path):
    for name, sizes in (("large.avi", [(20_000, 64)]), ("changes.avi", [(64, 48), (32, 48)])):
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream("png", rate=25)
            stream.width, stream.height, stream.pix_fmt = *sizes[0], "rgb24"
            for i, (width, height) in enumerate(sizes):
                packet = av.Packet(coded(".png", np.zeros((height, width, 3), np.uint8)))
                packet.stream, packet.pts, packet.dts, packet.time_base = (
                    stream,
                    i,
                    i,
                    stream.time_base or Fraction(1, 25),
                )
                packet.is_keyframe = True
                container.mux(packet)
    with pytest.raises(InputError, match=r"large\.avi: has pictures of 20000×64"):
        probe_video(tmp_path / "large.avi")
    with pytest.raises(InputError, match=r"its frame 1 is 32×48, but the video is 64×48"):
        list(read_frames(tmp_path / "changes.avi"))


def test_a_playlist_opens_no_other_file(tmp_path, film):
    segment = film.rename(film.with_name("a.ts")) if not film.with_name("a.ts").exists() else film.with_name("a.ts")
    text = f"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n{segment}\n#EXT-X-ENDLIST\n"
    (tmp_path / "a.m3u8").write_text(text)
    with pytest.raises(InputError):
        list(read_frames(tmp_path / "a.m3u8"))
    segment.rename(film)


def test_gaps_and_delays_of_damaged_time_stamps_are_bounded():
    class Picture:
        def __init__(self, pts):
            self.pts, self.key_frame, self.is_corrupt = pts, False, False

    line = Timeline(interval=1.0)
    for stamp in (0, 1, 10**12):
        line.add(stamp, True, torn=stamp > 1)
        line.show(Picture(stamp))
    assert line.number <= VIDEO_GAP_FRAMES
    line = Timeline(None)
    line.add(10**12, True)  # the decoder never returns this picture
    waiting = 0
    for stamp in range(500):
        line.add(stamp, False)
        line.show(Picture(stamp))
        waiting += 1 - len(list(line.ready()))
    assert waiting < 200


def test_mutations_of_a_video(tmp_path, film):
    valid = film.read_bytes()
    with Isolated("support.hostile_media:read_video") as reader:

        @many_examples
        @given(damaged_bytes(valid))
        def check(content):
            (tmp_path / "a.mp4").write_bytes(content)
            outcome = reader(tmp_path / "a.mp4")
            assert outcome.acceptable, outcome

        check()


def test_mutations_of_pictures(tmp_path):
    valid = {suffix: coded(suffix) for suffix in SUFFIXES}
    (tmp_path / "0.png").write_bytes(coded(".png"))
    with Isolated("support.hostile_media:read_video") as reader:

        @many_examples
        @given(st.sampled_from(SUFFIXES).flatmap(lambda suffix: damaged_bytes(valid[suffix])))
        def check(content):
            (tmp_path / "1.png").write_bytes(content)
            outcome = reader(tmp_path)
            assert outcome.acceptable, outcome

        check()
