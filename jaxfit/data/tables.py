"""Memory of tables that have a cell for every track in every frame, estimated before it is taken."""

from __future__ import annotations

from jaxfit.errors import InputError
from jaxfit.limits import TABLE_GB

__all__ = ["check_memory", "observations_bytes"]


def observations_bytes(num_tracks: int, num_frames: int, num_keypoints: int, name_characters: int = 0) -> int:
    """Return the largest memory that `Observations` and the copies of its construction take, in bytes.

    Args:
        num_tracks: N.
        num_frames: T.
        num_keypoints: K.
        name_characters: length of the longest file name of a frame.
    """
    return num_tracks * num_frames * (60 + 44 * num_keypoints) + num_frames * (80 + 12 * name_characters)


def check_memory(source: object, what: str, needed_bytes: float, remedy: str, allowed_gb: float = TABLE_GB) -> None:
    """Raise InputError if tables need more memory than is allowed.

    Args:
        source: the file, for the message.
        what: subject of the message, in the plural.
        needed_bytes: the estimate.
        remedy: the remedy of the message.
        allowed_gb: the largest memory in GB.
    """
    if needed_bytes > allowed_gb * 1e9:
        raise InputError(source, f"{what} need {needed_bytes / 1e9:,.1f} GB, more than {allowed_gb:g} GB", remedy)
