"""Read the pictures of a folder. Size and type are read from the header of a file before any pixel is decoded."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.limits import IMAGE_PIXELS, IMAGE_SIDE_PX, PICTURE_SCANS
from jaxfit.foundation.reading import check_folder, read_file

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")

_NUMBERS = re.compile(r"(\d*)(\D+|$)")
_JPEG_SEGMENT = re.compile(rb"\xff[^\x00\x01\xff\xd0-\xd8]", re.DOTALL)
"""The marker of a segment or of the end of a picture, but no marker within the compressed data of a scan."""
_WIDTH, _HEIGHT, _TILE_WIDTH, _TILE_HEIGHT = 256, 257, 322, 323  # tags of TIFF


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder in the order of their names, with numbers sorted by value.

    Raises:
        InputError: the folder cannot be read, or has no images.
    """
    check_folder(folder)
    try:
        # macOS writes files such as ._img0.png beside the pictures, which are no pictures
        files = [
            file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES and not file.name.startswith(".")
        ]
    except OSError as error:
        raise InputError(folder, f"cannot be read: {error.strerror}", "change its permissions") from error
    if not files:
        raise InputError(folder, "has no images", f"names of images end in {', '.join(IMAGE_SUFFIXES)}")
    return sorted(files, key=lambda file: [(int(n or 0), text) for n, text in _NUMBERS.findall(file.name)])


def read_picture(
    file: Path, grey: bool = False
) -> UInt8[np.ndarray, "H W *channels"] | UInt16[np.ndarray, "H W"] | None:
    """Return a picture in the channel order blue, green, red, or as grey values, turned upright by its EXIF data.

    Grey values of 16 bits stay as they are, because in pictures of masks they are the numbers of birds.

    Returns None for a file that is not a picture of a type in `IMAGE_SUFFIXES`, is damaged, or is too large.
    """
    try:
        content = read_file(file, "a picture")  # OpenCV cannot open a name that is not UTF-8
    except InputError:
        return None
    size = picture_size(content)
    if size is None or min(size) < 1 or is_too_large(*size):
        return None
    encoded = np.frombuffer(content, np.uint8)
    try:
        if not grey:
            return cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        picture = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
        is_whole = picture is None or picture.dtype in (np.uint8, np.uint16)
        return picture if is_whole else cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None


def is_too_large(width: int, height: int) -> bool:
    """Whether an image exceeds `IMAGE_SIDE_PX` or `IMAGE_PIXELS`."""
    return max(width, height) > IMAGE_SIDE_PX or width * height > IMAGE_PIXELS


def picture_size(content: bytes) -> tuple[int, int] | None:
    """Return the width and height in the header of a PNG, JPEG, BMP, TIFF or WebP picture.

    Returns None for other content, for a damaged header, and for a JPEG picture that takes absurdly long to decode.
    """
    try:
        if content.startswith(b"\x89PNG\r\n\x1a\n"):
            return _png_size(content)
        if content.startswith(b"\xff\xd8"):
            return _jpeg_size(content)
        if content.startswith(b"BM"):
            width, height = struct.unpack_from("<HH" if content[14] == 12 else "<ii", content, 18)
            return width, abs(height)
        if content.startswith((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")):
            return _tiff_size(content)
        if content.startswith(b"RIFF") and content[8:12] == b"WEBP":
            return _webp_size(content)
    except (struct.error, IndexError):  # the header is cut off
        pass
    return None


def _png_size(content: bytes) -> tuple[int, int] | None:
    """Return the size; None if a chunk is longer than the file, because OpenCV takes memory for the stated length."""
    size = width, height = struct.unpack_from(">II", content, 16)
    at = 8
    while at + 8 <= len(content):
        length, kind = struct.unpack_from(">I4s", content, at)
        if kind == b"fcTL":  # a frame of an animation lies within the picture
            frame = struct.unpack_from(">II", content, at + 12)
            if frame[0] > width or frame[1] > height:
                return None
        at += 12 + length
        if at > len(content):
            return None
        if kind == b"IEND":
            break
    return size


def _jpeg_size(content: bytes) -> tuple[int, int] | None:
    """Return the size in the frame header. A progressive picture may have many scans over all of its pixels."""
    at, size, scans = 2, None, 0
    while segment := _JPEG_SEGMENT.search(content, at):
        at, marker = segment.start(), segment[0][1]
        if size is None and 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", content, at + 5)
            size = width, height
        scans += marker == 0xDA
        if marker == 0xD9 or scans > PICTURE_SCANS:  # the end of the picture
            break
        at += 2 + struct.unpack_from(">H", content, at + 2)[0]
    return None if scans > PICTURE_SCANS else size


def _tiff_size(content: bytes) -> tuple[int, int] | None:
    """Return the size of the first page, or the size of its tiles if tiles are larger."""
    order = "<" if content[0] == ord("I") else ">"
    big = content[2:4] in (b"+\0", b"\0+")
    # number of entries, size of an entry, offset of the value in an entry
    count, entry, value = ("Q", 20, 12) if big else ("H", 12, 8)
    (at,) = struct.unpack_from(order + ("Q" if big else "I"), content, 8 if big else 4)
    (entries,) = struct.unpack_from(order + count, content, at)
    if entries > 4096:
        return None
    at += struct.calcsize(order + count)
    sizes = dict.fromkeys((_WIDTH, _HEIGHT, _TILE_WIDTH, _TILE_HEIGHT), 0)
    for i in range(entries):
        tag, kind = struct.unpack_from(order + "HH", content, at + entry * i)
        if tag in sizes:
            number = {1: "B", 3: "H", 4: "I", 16: "Q"}.get(kind, "I")
            (sizes[tag],) = struct.unpack_from(order + number, content, at + entry * i + value)
    if not (sizes[_WIDTH] and sizes[_HEIGHT]):
        return None
    return max(sizes[_WIDTH], sizes[_TILE_WIDTH]), max(sizes[_HEIGHT], sizes[_TILE_HEIGHT])


def _webp_size(content: bytes) -> tuple[int, int] | None:
    kind = content[12:16]
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", content, 26)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", content, 21)
        return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
    if kind == b"VP8X":
        width, height = struct.unpack_from("<HxH", content, 24)
        return 1 + (width | content[26] << 16), 1 + (height | content[29] << 16)
    return None
