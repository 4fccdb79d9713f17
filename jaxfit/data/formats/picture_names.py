"""Frame numbers from the names of pictures, such as `img0012.png` or `frame_000012.png`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from jaxfit.errors import InputError
from jaxfit.limits import FRAME_DIGITS

__all__ = ["frame_numbers"]

_NUMBERED = re.compile(rf"(.*?)(\d{{1,{FRAME_DIGITS}}})$", re.ASCII)
_UPLOADED = re.compile(r"^[0-9a-f]{8}-")
"""Text that Label Studio puts before the name of an uploaded picture."""


def frame_numbers(pictures: Sequence[str], video: Path | None = None) -> list[int] | None:
    """Return the frame numbers of the pictures of one video, or None for photographs.

    Pictures of one folder whose names differ only in the number at the end are frames of one video. If `video` is a
    folder that holds all pictures, the number of a frame is the position of the picture in this folder, as everywhere
    in jaxfit.

    Args:
        pictures: names of pictures, with their folders.
        video: the video or the folder of pictures, if it is known.

    Raises:
        InputError: the folder has no pictures.
    """
    paths = [PurePosixPath(picture.replace("\\", "/")) for picture in pictures]
    if len({path.parent for path in paths}) > 1:
        return None
    if video is not None and video.is_dir():
        from jaxfit.video.pictures import image_files  # imports the video libraries

        place = {file.name: i for i, file in enumerate(image_files(video))}
        found = [place.get(path.name, -1) for path in paths]
        if min(found, default=0) >= 0 and len(set(found)) == len(found):
            return found
        if max(found, default=0) >= 0:
            lacking = paths[found.index(-1)].name if -1 in found else paths[0].name
            raise InputError(video, f"lacks the picture {lacking}", "give the folder that holds all labelled pictures")
    matches = [_NUMBERED.fullmatch(_UPLOADED.sub("", path.stem)) for path in paths]
    named = [match for match in matches if match]
    if len(named) < len(paths) or len({match[1] for match in named}) > 1:
        return None
    numbers = [int(match[2]) for match in named]
    return numbers if len(set(numbers)) == len(numbers) else None
