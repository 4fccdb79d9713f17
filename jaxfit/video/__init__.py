"""Reading and writing of videos, and the names of codecs."""

from __future__ import annotations

__all__ = ["CODECS", "CONTAINERS"]

CODECS = {
    "h264": ("libx264", {"preset": "veryfast", "crf": "23", "x264-params": "cpu-independent=1"}),
    "vp9": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8", "row-mt": "1", "crf": "32", "b": "0"}),
    "mpeg4": ("mpeg4", {"qmin": "3", "qmax": "5"}),
}
"""Name → encoder and its settings. Browsers play h264 and vp9. Only players play mpeg4.

Without ``cpu-independent`` x264 wrote different bytes in every third run, on one machine and even with one thread."""
CONTAINERS = {".mp4": ("h264", "vp9", "mpeg4"), ".webm": ("vp9",)}
"""File name extension → codecs of the container, in the order of preference."""
