"""Decoding of video files by PyAV: frame numbers, presentation times, seeking, and pictures as players show them."""

from __future__ import annotations

import heapq
import logging
import math
import struct
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import av
import av.filter
import cv2
import numpy as np
from av import error as av_error
from av.error import FFmpegError
from av.sidedata.sidedata import Type
from av.stream import Disposition
from av.video.reformatter import ColorTrc, Interpolation
from jaxtyping import Float, UInt8

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import open_file

_logger = logging.getLogger(__name__)

EXACT = Interpolation.BILINEAR | Interpolation.ACCURATE_RND | Interpolation.BITEXACT
"""Settings that convert colours identically on every machine."""
MP4, MATROSKA = "mov,mp4,m4a,3gp,3g2,mj2", "matroska,webm"
"""Names of formats in FFmpeg. In both, every packet has a time stamp, so that seeks are exact."""
_RAW = ("h264", "hevc", "m4v", "mpegvideo", "mjpeg")
"""Formats that are only the stream of a codec. Without time stamps, the rate in the codec's header counts."""
_REORDER = 64  # packets; the time stamps of packets that are further apart in a file are in order
_FIRST_PACKETS = 500  # packets; a later first picture would make probing slow
_RESTART_S = 0.5  # seconds; a decoding time that falls by more is a clock that starts again
_FPS_RANGE = 1e-5, 1e5  # other rates come from damaged headers
_HDR = {ColorTrc.SMPTE2084: "PQ", ColorTrc.ARIB_STD_B67: "HLG"}
_LARGEST_TILT = math.tan(math.radians(1))  # players ignore smaller deviations from multiples of 90°, as FFmpeg does


class Frame(NamedTuple):
    """One frame of a video."""

    index: int
    """Number of the frame, from 0. The number of a picture does not depend on the first frame that is read."""
    picture: UInt8[np.ndarray, "H W 3"]
    """Pixels as players show the frame: upright and deinterlaced. The channel order is blue, green, red."""
    time_s: float | None
    """Presentation time in seconds: the time stamp of the container, which ffprobe shows as `pts_time`. An edit list is
    applied. The first frame often has the time 0, but transport streams and recordings that were cut begin later.
    Without time stamps, the number of the frame divided by the frame rate; None if the rate is unknown too."""


class NumberedPicture(NamedTuple):
    """A decoded picture with its number and time."""

    number: int
    time_s: float | None
    picture: Any
    """None if the picture is damaged."""


@contextmanager
def opened(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a file. Gives its container and its default video stream, as FFmpeg chooses it.

    Raises:
        InputError: the file is not a readable video.
    """
    with open_file(path, "a video") as file:
        try:
            # a playlist may name other files and network addresses
            container = av.open(file, options={"protocol_whitelist": "none"}, metadata_errors="replace")
        except (FFmpegError, OSError, ValueError) as error:
            problem = f"is not a readable video: {getattr(error, 'strerror', error)}"
            raise InputError(path, problem, "the file may be incomplete or of another type") from error
        with container:
            stream: Any = container.streams.best("video")
            # the cover picture of a music file is also a video stream
            if stream is None or stream.disposition & Disposition.attached_pic:
                raise InputError(path, "has no video stream", "give a video or a folder of images")
            if stream.codec_context is None:
                raise InputError(path, "has a codec that this PyAV cannot decode", "convert the video to H.264")
            films = [each for each in container.streams.video if not each.disposition & Disposition.attached_pic]
            if len(films) > 1:
                _warn_of_streams(path, films.index(stream) + 1, tuple((each.width, each.height) for each in films))
            stream.thread_type = "SLICE"  # with threads for frames, the detected damage would vary from run to run
            yield container, stream


@cache  # one line in a process
def _warn_of_streams(path: Path, number: int, sizes_px: tuple[tuple[int, int], ...]) -> None:
    shown = ", ".join(f"{width}×{height}" for width, height in sizes_px)
    text = "%s: has %d video streams (%s); number %d is read, the default stream"
    text += "; programs that read by OpenCV take number 1" if number > 1 else ""
    _logger.warning(text, path, len(sizes_px), shown, number)


def frame_count(stream: Any) -> int | None:
    """Return the number of frames that players show; None if the container does not store a number.

    An edit list of an MP4 file hides frames. FFmpeg marks these frames in its index, or leaves the frames out.
    """
    if not stream.frames or stream.container.format.name != MP4:
        return stream.frames or None
    return sum(not entry.is_discard for entry in stream.index_entries) or stream.frames


def frame_rate(stream: Any) -> float | None:
    """Return the mean frame rate in frames per second; None if the rate is unknown, or absurd because of damage."""
    rate = stream.average_rate or stream.guessed_rate
    if stream.container.format.name in _RAW:  # the mean rate is a default of FFmpeg, and so is a rate without a header
        rate = stream.guessed_rate if stream.codec_context.framerate else None
    return float(rate) if rate and _FPS_RANGE[0] <= rate <= _FPS_RANGE[1] else None


def first_picture(container: Any, stream: Any) -> Any:
    """Return the first picture that can be decoded; None if there is none in the first packets."""
    packets = container.demux(stream)
    for _ in range(_FIRST_PACKETS):
        try:
            packet = next(packets, None)
            pictures = [] if packet is None else stream.decode(packet)
        except FFmpegError:
            continue
        if packet is None or pictures:
            return pictures[0] if pictures else None
    return None


def frame_times(path: Path, stop: int) -> Float[np.ndarray, "F"]:
    """Return the presentation times of the frames of a video before frame `stop`, without decoding.

    Returns:
        (F,) times in seconds as `Frame.time_s`, at most `stop`; NaN for unknown times.

    Raises:
        InputError: the file is not a readable video.
    """
    with opened(path) as (_, stream):
        rate, time_base = frame_rate(stream), stream.time_base
    packets = _packets(path, stop)
    if packets.stamps is None:
        return np.arange(min(packets.count, stop)) / (rate or np.nan)
    return np.array([float(stamp * time_base) for stamp in packets.stamps[:stop]], np.float64)


def decode(
    path: Path, numbers: range, size_px: tuple[int, int], stopped: Callable[[], bool], part: int = 1
) -> Iterator[Frame | int]:
    """Yield the requested frames of a video in order. For a damaged frame, yield only its number.

    If the container has time stamps (mp4, mkv, webm), the packets of earlier frames are counted and not decoded.
    Decoding starts at the last keyframe before the first requested frame that refreshes the decoder at once (IDR), or
    else at the third last keyframe: a stream with gradual refresh has no true keyframes, and needs up to two of its
    recovery points until its pictures are complete.

    Args:
        path: the file.
        numbers: numbers of the requested frames.
        size_px: width and height of the video as players show it.
        stopped: called between packets; True ends the decoding.
        part: as for `read_frames`.

    Raises:
        InputError: the file is not a readable video, no picture of it can be decoded, or a picture has another size.
    """
    if not numbers:
        return
    with opened(path) as (container, stream):
        stamps, turn = _seek(path, container, stream, numbers.start), None
        for number, time_s, picture in deinterlaced(path, _numbered(path, container, stream, stamps, stopped)):
            if picture is not None and (turn is None or picture.key_frame):
                # reading it keeps a picture in memory until a garbage collection
                turn = display_turn(picture) or (False, False, False)
            if number in numbers:
                pixels = None if picture is None else _pixels(path, number, picture, turn, size_px, part)
                yield number if pixels is None else Frame(number, pixels, time_s)
            if number >= numbers[-1]:
                return


class _Packets(NamedTuple):
    """The frames at the beginning of a file, from its packets."""

    count: int
    stamps: list[int] | None
    """Time stamps in the order of presentation; None if stamps are missing or contradict each other."""
    keys: list[tuple[int, bool]]
    """Numbers of the keyframes, and whether they refresh the decoder at once."""


def _packets(path: Path, stop: int) -> _Packets:
    """Return the frames from the first picture that can be decoded to at least frame `stop`, without decoding."""
    with opened(path) as (container, stream):
        first, has_stamps = first_picture(container, stream), _has_stamps(container, stream)
    frames: list[tuple[int | None, bool, bool]] = []
    with opened(path) as (container, stream):
        try:
            for packet in filter(_is_shown, _rising(container, stream)):
                if first is None or None in (first.pts, packet.pts) or packet.pts >= first.pts:
                    frames.append((packet.pts, packet.is_keyframe, packet.is_keyframe and _refreshes(packet)))
                if len(frames) > stop + _REORDER:
                    break
        except FFmpegError:  # the file ends here
            pass
    stamps: set[Any] = {stamp for stamp, *_ in frames}
    if not has_stamps or None in stamps or len(stamps) < len(frames):
        return _Packets(len(frames), None, [])
    frames.sort()
    return _Packets(len(frames), sorted(stamps), [(i, whole) for i, (_, is_key, whole) in enumerate(frames) if is_key])


def _rising(container: Any, stream: Any) -> Iterator[Any]:
    """Yield the packets. Where the clock of a file starts again, the later time stamps continue the earlier ones.

    Recorders join transport streams whose clocks begin at 0 each.
    """
    shift, last, tick_s = 0, None, float(stream.time_base)
    for packet in container.demux(stream):
        if packet.dts is not None:
            if last is not None and (last - packet.dts - shift) * tick_s > _RESTART_S:
                shift = last + (packet.duration or 1) - packet.dts
            packet.dts += shift
            if packet.pts is not None:
                packet.pts += shift
            last = packet.dts
        yield packet


def _has_stamps(container: Any, stream: Any) -> bool:
    # AVI has no time stamps, and FFmpeg cannot derive correct time stamps for these codecs; the time stamps of a stream
    # without a rate are a default of FFmpeg
    is_avi = container.format.name == "avi" and stream.codec_context.name in ("h264", "hevc")
    return not (is_avi or (container.format.name in _RAW and frame_rate(stream) is None))


def _refreshes(packet: Any) -> bool:
    """Return whether the packet of a keyframe, as MP4 and Matroska store it, has an IDR picture of H.264 or HEVC."""
    kinds = {"h264": (31, 0, {5}), "hevc": (126, 1, {19, 20})}
    if packet.stream.codec_context.name not in kinds:
        return False
    mask, shift, wanted = kinds[packet.stream.codec_context.name]
    content, at = memoryview(packet), 0
    while at + 4 < len(content):  # units with their lengths before them
        if (content[at + 4] & mask) >> shift in wanted:
            return True
        at += 4 + int.from_bytes(content[at : at + 4], "big")
    return False


def _is_shown(packet: Any) -> bool:
    """Return whether players show the picture of a packet."""
    # no content: a repeated picture in AVI, or the end of a stream. VP8 has packets that serve only as references.
    hidden = packet.size and packet.stream.codec_context.name == "vp8" and not memoryview(packet)[0] & 0x10
    return bool(packet.size) and not hidden and not packet.is_discard


def _seek(path: Path, container: Any, stream: Any, start: int) -> list[int]:
    """Move to a keyframe before frame `start` (`decode`); return the time stamps of the frames up to there and beyond.

    Returns an empty list, and stays at the beginning, if the file has no time stamps to seek by.
    """
    if not start or container.format.name not in (MP4, MATROSKA):
        return []
    packets = _packets(path, start)
    keys = [key for key in packets.keys if key[0] <= start][-3:]
    first = next((number for number, refreshes in reversed(keys) if refreshes), keys[0][0] if keys else 0)
    if packets.stamps is None or first == 0:
        return []
    container.seek(packets.stamps[first], stream=stream)
    return packets.stamps


def _numbered(
    path: Path, container: Any, stream: Any, stamps: list[int], stopped: Callable[[], bool]
) -> Iterator[NumberedPicture]:
    """Yield the pictures from the current position of a container on, in the order of their numbers.

    A number is a rank: the number of packets in the file that are shown earlier. It is correct for a variable frame
    rate, and does not change if a picture cannot be decoded. As in OpenCV, counting begins at the first picture of the
    file that can be decoded. If time stamps are missing or contradict each other, pictures are counted as they come.

    A damaged or missing picture spoils all pictures after it, up to the next keyframe, because decoders do not report
    which of these pictures repeat the damage.

    Args:
        path, container, stream: the opened file.
        stamps: time stamps of the frames of the file up to a frame after the current position; empty at its beginning.
        stopped: as for `decode`.
    """
    number = len(stamps)
    has_stamps, rate = _has_stamps(container, stream), frame_rate(stream)
    waiting: list[Any] = []  # the time stamps of packets whose pictures were not yet decoded, as a heap
    last: Any = -math.inf
    is_begun, is_spoilt, problem = False, False, ""

    def numbered(picture: Any, stamp: int | None) -> NumberedPicture:
        nonlocal number
        time_s = number / rate if rate else None
        if has_stamps and stamp is not None:
            time_s = float(stamp * stream.time_base)
        number += 1
        return NumberedPicture(number - 1, time_s, picture)

    packets = _rising(container, stream)
    packet: Any = True
    while packet is not None and not stopped():
        try:
            packet = next((packet for packet in packets if packet.size), None)
        except FFmpegError as error:  # the container is damaged: the decoder still returns its last pictures
            packet, problem = None, f": {error.strerror}"
        if packet is not None and _is_shown(packet):
            has_stamps = has_stamps and packet.pts is not None
            if has_stamps:
                heapq.heappush(waiting, packet.pts)
        try:
            pictures = stream.decode(packet)  # None flushes the decoder
        except FFmpegError as error:
            pictures, is_spoilt = [], True
            problem = problem if is_begun else f": {error.strerror}"
            if not has_stamps and is_begun:
                yield numbered(None, None)
        for picture in pictures:
            stamp: Any = picture.pts
            has_stamps = has_stamps and stamp is not None and stamp > last
            if not is_begun:
                is_begun, problem = True, ""
                warn_of_difference(path, stream, picture)
                waiting = [later for later in waiting if has_stamps and later >= stamp]
                heapq.heapify(waiting)
                number = bisect_left(stamps, stamp) if stamps and stamp is not None else 0
            while has_stamps and waiting and waiting[0] < stamp:
                is_spoilt = True
                yield numbered(None, heapq.heappop(waiting))
            if has_stamps:
                last = stamp
                if waiting and waiting[0] == last:
                    heapq.heappop(waiting)
            is_spoilt = picture.is_corrupt or (is_spoilt and not picture.key_frame)
            yield numbered(None if is_spoilt else picture, stamp)
    if stopped():
        return
    while has_stamps and is_begun and waiting:
        last = heapq.heappop(waiting)
        yield numbered(None, last)
    if not is_begun and not stamps:
        raise InputError(path, f"no frame can be decoded{problem}", "the file may be incomplete or damaged")
    expected, end_s = frame_count(stream), number / rate if rate else 0.0
    if has_stamps and is_begun:
        end_s = float(last * stream.time_base)
    if problem or number < (expected or 0):
        _logger.warning("%s: ends after %d of %s frames%s", path, number, expected or "more", problem)
    elif not expected and container.duration and len(container.streams) == 1:
        promised_s = container.duration / av.time_base
        if end_s + 1 < promised_s:
            _logger.warning("%s: ends after %.1f of %.1f seconds", path, end_s, promised_s)


def deinterlaced(path: Path, pictures: Iterator[NumberedPicture]) -> Iterator[NumberedPicture]:
    """Yield the pictures; from the first interlaced picture on, interlaced pictures are deinterlaced.

    FFmpeg's filter `bwdif` fills the lines of one field from the other field and from the neighbours of the picture.
    Damaged pictures are not used.
    """
    graph: Any = None
    waiting: deque[NumberedPicture] = deque()

    def filtered() -> Iterator[NumberedPicture]:
        """Yield the pictures that the filter has finished, with the damaged pictures between them."""
        while waiting:
            try:
                picture = None if waiting[0].picture is None else graph.vpull()
            except (av_error.BlockingIOError, av_error.EOFError):  # it needs the next picture, or has no more
                return
            yield waiting.popleft()._replace(picture=picture)

    for numbered in pictures:
        picture = numbered.picture
        if graph is None and picture is not None and picture.interlaced_frame:
            graph = _deinterlacer(picture)
        if graph is None:
            yield numbered
            continue
        waiting.append(numbered)
        if picture is not None:
            try:
                graph.vpush(picture)
            except FFmpegError as error:
                raise InputError(
                    path, f"its frame {numbered.number} cannot be deinterlaced: {error.strerror}"
                ) from error
        yield from filtered()
    if graph is not None:
        graph.vpush(None)
        yield from filtered()


def _deinterlacer(first: Any) -> Any:
    """Return a filter for pictures of the format of the first picture."""
    graph = av.filter.Graph()
    source = graph.add(
        "buffer",
        video_size=f"{first.width}x{first.height}",
        pix_fmt=first.format.name,
        time_base=str(first.time_base or "1/1000"),
        pixel_aspect="1/1",
        colorspace=str(int(first.colorspace)),
        range=str(int(first.color_range)),
    )
    bwdif = graph.add("bwdif", mode="send_frame", deint="interlaced")
    graph.link_nodes(source, bwdif, graph.add("buffersink")).configure()
    return graph


def display_turn(picture: Any) -> tuple[bool, bool, bool] | None:
    """Return how players turn a decoded picture: whether rows and columns are swapped, then x and y reversed.

    The display matrix (a b u; c d v; x y w) of a container or of a codec maps the coded position (p, q) to the shown
    position (a·p + c·q + x, b·p + d·q + y). Scale and translation are ignored, as FFmpeg ignores both.

    Returns:
        Three flags; None for an angle between multiples of 90°.
    """
    try:
        content = next((bytes(data) for data in picture.side_data if data.type == Type.DISPLAYMATRIX), None)
    except ValueError:  # data of a type that PyAV does not know
        content = None
    if content is None or len(content) != 36:
        return False, False, False
    a, b, _, c, d, *_ = struct.unpack("=9i", content)
    straight, crossed = math.hypot(a, d), math.hypot(b, c)
    if crossed <= _LARGEST_TILT * straight:
        return False, a < 0, d < 0
    if straight <= _LARGEST_TILT * crossed:
        return True, c < 0, b < 0
    return None


def displayed_size(picture: Any) -> tuple[int, int]:
    """Return the width and height in pixels of a decoded picture as players show the picture."""
    is_transposed = (display_turn(picture) or (False,))[0]
    return (picture.height, picture.width) if is_transposed else (picture.width, picture.height)


def _pixels(
    path: Path, number: int, picture: Any, turn: Any, size_px: tuple[int, int], part: int
) -> UInt8[np.ndarray, "H W 3"]:
    """Return the pixels of a decoded picture, turned as players turn the picture.

    The conversion follows the colour matrix and the range of the picture; BT.601 without a matrix, as in FFmpeg.
    """
    is_transposed, is_reversed_x, is_reversed_y = turn
    width, height = (picture.height, picture.width) if is_transposed else (picture.width, picture.height)
    if (width, height) != size_px:
        problem = f"its frame {number} is {width}×{height}, but the video is {size_px[0]}×{size_px[1]}"
        raise InputError(path, problem, "convert the video to a single size")
    if part == 1:
        picture_bgr = picture.to_ndarray(format="bgr24", interpolation=EXACT)
    else:
        smaller = {"width": max(picture.width // part, 1), "height": max(picture.height // part, 1)}
        picture_bgr = picture.to_ndarray(format="bgr24", interpolation=Interpolation.AREA, **smaller)
    if is_transposed:
        picture_bgr = cv2.transpose(picture_bgr)
    if is_reversed_x or is_reversed_y:
        picture_bgr = cv2.flip(picture_bgr, -1 if is_reversed_x and is_reversed_y else int(is_reversed_x))
    return picture_bgr


def warn_of_difference(path: Path, stream: Any, picture: Any) -> None:
    """Warn of unknown times, and if players show a video tilted, with stretched pixels, or with tone mapping."""
    if frame_rate(stream) is None and not _has_stamps(stream.container, stream):
        _logger.warning("%s: states no frame rate, so the times of its frames are unknown", path)
    if display_turn(picture) is None:
        _logger.warning("%s: players tilt this video by an angle between multiples of 90°, jaxfit does not", path)
    aspect = stream.sample_aspect_ratio
    if aspect and aspect != 1:
        remedy = "convert the video to square pixels, because the camera model needs square pixels"
        ratio = f"{aspect.numerator}:{aspect.denominator}"
        _logger.warning("%s: players stretch the pixels of this video to %s; %s", path, ratio, remedy)
    if picture.color_trc in _HDR:
        kind = _HDR[picture.color_trc]
        _logger.warning("%s: is HDR video (%s), so that colours look pale; convert the video to SDR", path, kind)
