"""A reconstruction of the toy footage that stops at a chosen point: by an exception, or because its process is killed.

`python -m support.interrupted FOLDER POINT` runs the command `reconstruct` in FOLDER and kills itself at POINT.
"""

import json
import os
import signal
import sys
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np

from jaxfit import pipeline
from jaxfit.cli.main import main
from jaxfit.fitting import stored_windows
from jaxfit.fitting.stored_windows import StoredWindows
from jaxfit.foundation.unfinished import Parts
from jaxfit.perception import detections, track
from support.toy_footage import QUICK, Footage, TrueKeypoints, TrueSegmenter

FOOTAGE = Footage()
FRAMES_PER_PART = 5
CONFIG = QUICK.replace("window: 12", "window: 6")
"""Two windows for each of three birds."""


@contextmanager
def toy_networks(segmenter):
    """Replace the networks of a config, and store few frames at a time."""
    with (
        mock.patch.object(track, "open_segmenter", return_value=segmenter),
        mock.patch.object(track, "open_keypoint_detector", return_value=TrueKeypoints(FOOTAGE)),
        mock.patch.object(pipeline, "check_segmenter"),
        mock.patch.object(pipeline, "with_chosen_segmenter", side_effect=lambda _, config, *__: (config, None)),
        mock.patch.object(pipeline, "open_keypoint_detector", return_value=TrueKeypoints(FOOTAGE)),
        mock.patch.object(pipeline, "network_files", return_value={}),
        mock.patch.object(detections, "FRAMES_PER_PART", FRAMES_PER_PART),
        mock.patch.object(stored_windows, "MIN_FRAMES", 1),
    ):
        yield segmenter


@contextmanager
def stopping(point, stop):
    """Call `stop` at a point: `frame 7`, `part 1` (half written), `windows 1`, `result` or `never`."""
    kind, _, number = point.partition(" ")
    count = int(number or 0)
    segment, add, store = TrueSegmenter.__call__, StoredWindows.add, Parts.add
    write = pipeline.write_solution

    def segmented(self, frame):
        if kind == "frame" and frame[0, 0, 0] == count:
            stop()
        return segment(self, frame)

    def added(self, windows, results, contents):
        add(self, windows, results, contents)
        if kind == "windows" and len(self._parts.numbers) == count:
            stop()

    def stored(self, arrays):
        if kind != "part" or len(self.numbers) != count:
            return store(self, arrays)

        def half(file, **_):
            file.write(b"half")
            file.flush()
            stop()

        with mock.patch.object(np, "savez_compressed", half):
            return store(self, arrays)

    def written(*args):
        write(*args)
        if kind == "result":
            stop()

    with (
        mock.patch.object(TrueSegmenter, "__call__", segmented),
        mock.patch.object(StoredWindows, "add", added),
        mock.patch.object(Parts, "add", stored),
        mock.patch.object(pipeline, "write_solution", written),
    ):
        yield


def command(folder, *more, out="result"):
    """Return the command; `folder` holds `frames`, `toy.npz` and `quick.yaml`."""
    given = [str(folder / "frames"), "--config", str(folder / "quick.yaml"), "--model", str(folder / "toy.npz")]
    return ["reconstruct", *given, "--out", str(folder / out), *more]


def contents(folder):
    """Return the content of a result that an interruption must not change."""
    files = {name: (folder / name).read_bytes() for name in ("poses.npz", "observations.json", "config.yaml")}
    summary = json.loads((folder / "summary.json").read_text())
    differs = "seconds", "seconds_of_tracking", "video"
    return files | {key: value for key, value in summary.items() if key not in differs}


if __name__ == "__main__":
    with toy_networks(TrueSegmenter(FOOTAGE)), stopping(sys.argv[2], lambda: os.kill(os.getpid(), signal.SIGKILL)):
        sys.exit(main(command(Path(sys.argv[1]))))
