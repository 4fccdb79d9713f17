"""Films as cameras make them: turned by a flag, interlaced, with 10 bits, with an edit list.

The expected counts, sizes and times come from ffprobe 6.0 (`-show_frames`, `-show_streams`).
"""

import logging
from fractions import Fraction

import numpy as np
import pytest
from support.films import encode, number_in, numbered, overwrite, packets, solid, trim

from jaxfit.video.reader import probe_video, read_frames


@pytest.fixture(scope="module")
def upright(tmp_path_factory):
    return encode(tmp_path_factory.mktemp("films") / "upright.mp4", count=12)


TURNS = {  # rotation counterclockwise and reflections → the picture as numpy turns the picture
    (0, False, False): lambda p: p,
    (90, False, False): lambda p: np.rot90(p),
    (180, False, False): lambda p: np.rot90(p, 2),
    (270, False, False): lambda p: np.rot90(p, 3),
    (0, True, False): lambda p: p[:, ::-1],
    (0, False, True): lambda p: p[::-1],
    (90, True, False): lambda p: np.rot90(p)[:, ::-1],
    (90, False, True): lambda p: np.rot90(p)[::-1],
}


@pytest.mark.parametrize(("turn", "kind"), [(turn, "mp4") for turn in TURNS] + [((90, False, False), "mkv")])
def test_turned_films(tmp_path, upright, caplog, turn, kind):
    path = encode(tmp_path / f"a.{kind}", count=12, turn=turn)
    expected = [TURNS[turn](frame.picture) for frame in read_frames(upright)]
    width, height = (80, 128) if turn[0] in (90, 270) else (128, 80)
    assert probe_video(path).size_px == (width, height)
    for start in (0, 7):
        read = list(read_frames(path, start))
        assert [frame.index for frame in read] == list(range(start, 12))
        for frame in read:
            assert frame.picture.flags.c_contiguous
            np.testing.assert_array_equal(frame.picture, expected[frame.index])
    assert caplog.records == []


def test_a_tilted_film_stays_and_is_reported(tmp_path, upright, caplog):
    caplog.set_level(logging.WARNING, "jaxfit")
    path = encode(tmp_path / "a.mp4", count=12, turn=(30, False, False))
    first = next(iter(read_frames(path))).picture
    np.testing.assert_array_equal(first, next(iter(read_frames(upright))).picture)
    assert [record.getMessage() for record in caplog.records] == [
        f"{path}: players tilt this video by an angle between multiples of 90°, jaxfit does not"
    ]


def woven(i):
    """Return an interlaced picture: even lines of one time, odd lines of the next time."""
    picture = numbered(2 * i)
    picture[1::2] = numbered(2 * i + 1)[1::2]
    return picture


def comb(picture):
    """Return how much the lines of the moving texture differ from their neighbours, in grey values."""
    lines = picture[:64].mean(-1)
    return np.abs(lines[1:-1] - (lines[:-2] + lines[2:]) / 2).mean()


@pytest.fixture(scope="module")
def interlaced(tmp_path_factory):
    options = {"x264-params": "tff=1:bframes=2:scenecut=0"}
    path = tmp_path_factory.mktemp("films") / "interlaced.mp4"
    return encode(path, count=40, gop=10, options=options, picture_of=woven)


def test_interlaced_films(interlaced):
    read = list(read_frames(interlaced))
    assert [number_in(frame.picture) // 2 for frame in read] == [frame.index for frame in read] == list(range(40))
    np.testing.assert_allclose([frame.time_s for frame in read], np.arange(40) / 25)
    for frame in read:
        assert comb(frame.picture) < 0.6 * comb(woven(frame.index))
    for start, stop in ((1, 2), (17, 19), (25, 40), (39, 40)):
        some = list(read_frames(interlaced, start, stop))
        assert [frame.index for frame in some] == list(range(start, stop))
        for frame in some:
            np.testing.assert_array_equal(frame.picture, read[frame.index].picture)
            assert frame.time_s == read[frame.index].time_s


def test_a_damaged_interlaced_film(tmp_path, interlaced):
    """Pictures beside damage lack a neighbour. Numbers stay, and pictures away from the damage are the same."""
    path = tmp_path / "a.mp4"
    path.write_bytes(interlaced.read_bytes())
    position, size, _ = packets(path)[13]
    overwrite(path, position + size // 3, size // 2)
    whole = {frame.index: frame.picture for frame in read_frames(interlaced)}
    reader = read_frames(path)
    given = {frame.index: frame.picture for frame in reader}
    assert reader.damaged
    assert set(reader.damaged) <= set(range(9, 20))
    assert sorted([*given, *reader.damaged]) == list(range(40))
    assert [number_in(picture) // 2 for picture in given.values()] == list(given)
    beside = {number + step for number in reader.damaged for step in (-1, 1)}
    for number in given.keys() - beside:
        np.testing.assert_array_equal(given[number], whole[number])


# matrix of H.273 → its weights of red and blue
WEIGHTS = {1: (0.2126, 0.0722), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
COLOURS = np.array([[200, 40, 30], [30, 180, 60], [40, 60, 210], [128, 128, 128], [250, 250, 20], [5, 5, 5]]) / 255


def coded(colours, matrix, bits, full_range):
    """Return Y, U, V of colours red, green, blue in 0…1, by the equations of H.273."""
    red, blue = WEIGHTS[matrix]
    luma = colours @ [red, 1 - red - blue, blue]
    chroma = [(colours[:, 2] - luma) / (2 - 2 * blue), (colours[:, 0] - luma) / (2 - 2 * red)]
    top = 2**bits - 1
    spans = (top, top, 0) if full_range else (219 << bits - 8, 224 << bits - 8, 16 << bits - 8)
    values = np.stack([luma * spans[0] + spans[2], *(c * spans[1] + (1 << bits - 1) for c in chroma)], -1)
    return np.rint(values).astype(int)


@pytest.mark.parametrize(
    ("codec", "bits", "matrix", "full_range"),
    [("libx264", 8, matrix, full) for matrix in WEIGHTS for full in (False, True)]
    + [("libx264", 10, 1, False), ("libx265", 10, 9, True)],
)
def test_colours_by_depth_matrix_and_range(tmp_path, codec, bits, matrix, full_range):
    pix_fmt = "yuv420p" if bits == 8 else "yuv420p10le"
    path = solid(tmp_path / "a.mp4", coded(COLOURS, matrix, bits, full_range), pix_fmt, matrix, full_range, codec)
    read = np.stack([frame.picture[32, 32, ::-1] for frame in read_frames(path)])
    np.testing.assert_allclose(read, 255 * COLOURS, atol=4)  # swscale rounds


@pytest.mark.parametrize(("first", "count"), [(0, 100), (60, 30), (7, 1)])
def test_an_edit_list(tmp_path, caplog, first, count):
    path = encode(tmp_path / "a.mp4", options={"bf": "2"})
    trim(path, first, count)
    caplog.set_level(logging.WARNING, "jaxfit")
    assert probe_video(path).frames == count
    for start in (0, count // 2):
        read = list(read_frames(path, start))
        assert [frame.index for frame in read] == list(range(start, count))
        assert [number_in(frame.picture) for frame in read] == [first + frame.index for frame in read]
        np.testing.assert_allclose([frame.time_s for frame in read], np.arange(start, count) / 25)
    assert caplog.records == []


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (
            {"sample_aspect_ratio": Fraction(4, 3)},
            "players stretch the pixels of this video to 4:3; convert the video to",
        ),
        ({"color_trc": 16}, "is HDR video (PQ), so that colours look pale; convert the video to SDR"),
        ({"color_trc": 18}, "is HDR video (HLG), so that colours look pale; convert the video to SDR"),
        ({"sample_aspect_ratio": Fraction(1), "color_trc": 1}, None),
    ],
)
def test_pixels_that_are_not_square_and_hdr_are_reported(tmp_path, caplog, settings, message):
    caplog.set_level(logging.WARNING, "jaxfit")
    list(read_frames(solid(tmp_path / "a.mp4", [(60, 128, 128)] * 3, "yuv420p", 1, False, **settings)))
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == (message is not None)
    assert message is None or f"a.mp4: {message}" in messages[0]
