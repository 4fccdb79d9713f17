"""Calls of the readers of videos and pictures for `support.hostile`."""

from jaxfit.video.reader import read_frames


def read_video(path: str) -> None:
    """Read all frames of a video, or of a folder of pictures."""
    for _ in read_frames(path):
        pass
