"""Read pictures by Pillow: the files of a folder, and the pages of a TIFF file."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import (  # the plugins register their formats
    BmpImagePlugin,  # noqa: F401
    Image,
    ImageOps,
    JpegImagePlugin,  # noqa: F401
    PngImagePlugin,  # noqa: F401
    TiffImagePlugin,  # noqa: F401
    WebPImagePlugin,  # noqa: F401
)

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import check_folder, open_file

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")

_FORMATS = ("PNG", "JPEG", "BMP", "TIFF", "WEBP")  # some other formats of Pillow start programs
_NUMBERS = re.compile(r"(\d*)(\D+|$)")


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder in the order of their names, with numbers sorted by value (equal numbers as text).

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
    return sorted(
        files, key=lambda file: [(int(n or 0), text) for n, text in _NUMBERS.findall(file.name)] + [(0, file.name)]
    )


def read_picture(
    file: Path, grey: bool = False
) -> UInt8[np.ndarray, "H W *channels"] | UInt16[np.ndarray, "H W"] | None:
    """Return a picture in the channel order blue, green, red, or as grey values, turned upright by its EXIF data.

    Grey values of 16 bits stay as they are where grey values are requested, because in pictures of masks they are the
    numbers of birds; in colours, their upper 8 bits are returned.

    Returns None for a file that is not a picture of a type in `IMAGE_SUFFIXES`, is damaged, or is so large that Pillow
    suspects an attack.
    """
    try:
        with open_file(file, "a picture") as opened, Image.open(opened, formats=_FORMATS) as image:
            return _pixels(image, grey)
    except Exception:  # Pillow raises any class for damaged content
        return None


def page_count(file: Path) -> int:
    """Return the number of pages of a TIFF file: stacks of microscopes and thermal cameras have a page per frame.

    Raises:
        InputError: the file is not a picture.
    """
    try:
        with open_file(file, "a picture") as opened, Image.open(opened, formats=_FORMATS) as image:
            return getattr(image, "n_frames", 1)
    except InputError:
        raise
    except Exception as error:
        raise InputError(file, f"is not a picture that can be read: {error}", "write the file again") from error


def read_pages(file: Path, numbers: range) -> Iterator[tuple[int, UInt8[np.ndarray, "H W 3"] | None]]:
    """Yield the numbers and the pictures of the pages of a TIFF file; None for a page that is damaged."""
    with open_file(file, "a picture") as opened, Image.open(opened, formats=_FORMATS) as image:
        for page in numbers:
            try:
                image.seek(page)
                picture = _pixels(image, grey=False)
            except Exception:
                picture = None
            yield page, picture


def _pixels(image: Image.Image, grey: bool) -> np.ndarray:
    """Return the pixels of a picture as `read_picture`."""
    ImageOps.exif_transpose(image, in_place=True)
    if image.mode.startswith("I"):  # 16 bits per pixel; Pillow reads some of these pictures as 32 bits
        values = np.asarray(image).clip(0, 2**16 - 1).astype(np.uint16)
        return values if grey else np.repeat((values >> 8).astype(np.uint8)[..., None], 3, axis=2)
    mode = "L" if grey else "RGB"
    values = np.array(image if image.mode == mode else image.convert(mode))
    return values if grey else cv2.cvtColor(values, cv2.COLOR_RGB2BGR)
