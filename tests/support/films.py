"""Small videos, and damage to their files."""

import struct
import threading
from fractions import Fraction

import av
import cv2
import numpy as np

from jaxfit.video.writer import VideoWriter

SIZE, FPS, COUNT = (64, 48), 12.5, 30
BITS, CELL_PX = 8, 16


def frames(size=SIZE, count=COUNT):
    """Yield a moving colour field, smooth enough for 4:2:0, with a pure blue, a pure green and a pure red patch."""
    rng = np.random.default_rng(0)
    field = cv2.resize(rng.integers(40, 215, (4, 6, 3), dtype=np.uint8), size, interpolation=cv2.INTER_LINEAR)
    for i in range(count):
        frame = np.roll(field, i, axis=1)
        for channel in range(3):
            frame[8:24, 16 * channel : 16 * channel + 16] = 255 * np.eye(3, dtype=np.uint8)[channel]
        yield frame


def write(path, codec="auto", size=SIZE, count=COUNT):
    with VideoWriter(path, size, FPS, codec) as writer:
        for frame in frames(size, count):
            writer.write(frame)
    return writer


def numbered(i):
    """Return a picture of a moving texture above black and white cells that encode the number i."""
    field = np.random.default_rng(7).integers(0, 255, (12, 24, 3), dtype=np.uint8)
    field = cv2.resize(field, (BITS * CELL_PX, 64), interpolation=cv2.INTER_LINEAR)
    bits = [255 * (i >> bit & 1) for bit in range(BITS)]
    cells = np.repeat(np.repeat([bits], CELL_PX, axis=0), CELL_PX, axis=1).astype(np.uint8)
    return np.vstack([np.roll(field, (3 * i, 5 * i), (0, 1)), np.repeat(cells[..., None], 3, axis=2)])


def number_in(picture):
    """Return the number that `numbered` encoded in a picture."""
    centres = picture[-CELL_PX // 2, CELL_PX // 2 :: CELL_PX].mean(-1)
    return sum(1 << bit for bit in range(BITS) if centres[bit] > 127)


def encode(
    path,
    codec="libx264",
    count=100,
    gop=20,
    ticks=None,
    options=None,
    b_frames=None,
    turn=None,
    picture_of=numbered,
    rate=25,
):
    """Write a video of `numbered` pictures at `rate` frames per second, or at times `ticks` in units of 1/100 s.

    `turn` is the rotation of the display matrix in degrees counterclockwise, and whether to mirror x and y after it.
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate if ticks is None else 100, options=options or {})
        stream.width, stream.height = BITS * CELL_PX, 64 + CELL_PX
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        stream.codec_context.gop_size = gop
        if turn is not None:
            stream.set_display_rotation(*turn)
        stream.codec_context.thread_count = 1
        if b_frames is not None:
            stream.codec_context.max_b_frames = b_frames
        for i in range(count):
            picture = av.VideoFrame.from_ndarray(picture_of(i), format="bgr24")
            picture.pts, picture.time_base = (i, Fraction(1, rate)) if ticks is None else (ticks[i], Fraction(1, 100))
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return path


def solid(path, colours, pix_fmt, matrix, full_range, codec="libx264", **settings):
    """Write one lossless picture for every colour (Y, U, V in the depth of the format), with a tag for the matrix."""
    with av.open(str(path), "w") as container:
        options = {"qp": "0"} if codec == "libx264" else {"x265-params": "lossless=1:log-level=error"}
        stream = container.add_stream(codec, rate=25, options=options)
        stream.width, stream.height, stream.pix_fmt = 64, 64, pix_fmt
        stream.codec_context.color_range = 2 if full_range else 1
        stream.codec_context.colorspace = matrix
        for name, value in settings.items():
            setattr(stream.codec_context, name, value)
        dtype = np.uint16 if pix_fmt.endswith("10le") else np.uint8
        for i, colour in enumerate(colours):
            picture = av.VideoFrame(64, 64, pix_fmt)
            for plane, value in zip(picture.planes, colour, strict=True):
                plane.update(np.full(plane.buffer_size // np.dtype(dtype).itemsize, value, dtype).tobytes())
            picture.pts, picture.time_base = i, Fraction(1, 25)
            picture.color_range, picture.colorspace = 2 if full_range else 1, matrix
            container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    return path


def trim(path, first, count):
    """Change the edit list of an MP4 film at 25 frames per second, so that players show `count` frames from `first`."""
    content = bytearray(path.read_bytes())
    edit, media = content.index(b"elst") + 4, content.index(b"mdhd") + 4
    (ticks_per_s,) = struct.unpack_from(">I", content, media + 12)
    _, begin = struct.unpack_from(">Ii", content, edit + 8)
    struct.pack_into(
        ">Ii", content, edit + 8, 40 * count, begin + first * ticks_per_s // 25
    )  # the film has 1000 ticks/s
    path.write_bytes(content)


def packets(path):
    """Return position, size and keyframe flag of every packet in the order of the file."""
    with av.open(str(path)) as container:
        return [(packet.pos, packet.size, packet.is_keyframe) for packet in container.demux(video=0) if packet.size]


def overwrite(path, at, length):
    """Overwrite a part of a file with random bytes."""
    content = bytearray(path.read_bytes())
    assert 0 < at < at + length < len(content)
    content[at : at + length] = np.random.default_rng(1).integers(0, 256, length, dtype=np.uint8).tobytes()
    path.write_bytes(content)


def reader_threads():
    """The threads that decode frames ahead."""
    return [thread for thread in threading.enumerate() if thread.name == "ahead"]
