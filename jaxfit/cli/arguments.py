"""The parser of a command, and arguments that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from jaxfit.foundation.errors import InputError
from jaxfit.video import CODECS

MODEL = "`murre`, `aves` (after `jaxfit model get aves`), or a model file (.npz) that `jaxfit model import` writes"
OBSERVATIONS = (
    "keypoints and masks: COCO, Label Studio (.json), DeepLabCut (.h5, .csv), Lightning Pose (.csv) or SLEAP (.slp, "
    ".analysis.h5)"
)


def _names(text: str) -> list[str]:
    return [name for name in text.split(",") if name]


TRACK_OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "--segmenter": ("segmenter.file", {"metavar": "S.onnx"}),
    "--keypoints": ("keypoints.file", {"metavar": "K.onnx"}),
    "--classes": ("segmenter.classes", {"metavar": "NAME,NAME", "type": _names}),
    "--start": ("frames.start", {"metavar": "FRAME", "type": int}),
    "--stop": ("frames.stop", {"metavar": "FRAME", "type": int}),
    "--step": ("frames.step", {"metavar": "N", "type": int}),
    "--min-score": ("segmenter.min_score", {"metavar": "SCORE", "type": float}),
    "--tile-px": ("segmenter.tile_px", {"metavar": "PX", "type": int}),
    "--min-track-frames": ("min_track_frames", {"metavar": "N", "type": int}),
    "--min-track-score": ("min_track_score", {"metavar": "SCORE", "type": float}),
}
"""Option of the commands that track → the path of its setting in `TrackConfig`, which holds its description."""


SHARED: dict[str, dict[str, Any]] = {
    "result": {"type": Path, "metavar": "RESULT", "help": "folder of a result"},
    "--model": {"default": "murre", "help": f"{MODEL} (default %(default)s)"},
    "--frames": {"metavar": "A:B", "help": "only the frames from A to B; B is left out"},
    "--fps": {"type": float, "help": "frame rate of the footage (default: that of the result)"},
    "--video": {
        "type": Path,
        "help": "the footage, if the result does not name the footage, or the footage was moved",
    },
    "--observations": {
        "type": Path,
        "metavar": "OBS.json",
        "help": "the file that was fitted, for a result of `jaxfit fit`",
    },
    "--camera": {
        "metavar": "NAME",
        "help": "for a result in a world: the camera of the video, by its name in cameras.toml (default: the first "
        "camera)",
    },
    "--tracks": {"metavar": "ID,ID", "help": "only these tracks"},
    "--from": {
        "type": Path,
        "dest": "source",
        "metavar": "DIR",
        "help": "folder with copies of the files, for a machine without a network",
    },
    "--json": {"action": "store_true", "help": "print JSON instead of a table"},
    "--unit": {
        "choices": ("m", "cm", "mm"),
        "help": "unit of length of the file (default: that of the file, or the usual one of the program)",
    },
    "--focal-px": {
        "type": float,
        "metavar": "F",
        "help": "focal length of the camera in image pixels, without --cameras (default: estimated, with large errors)",
    },
    "--force": {
        "action": "store_true",
        "help": "draw on the video even if it is not the video of the result (image size, number of frames, first "
        "frame)",
    },
    "--codec": {
        "default": "auto",
        "choices": ("auto", *CODECS),
        "help": "codec of the video (default auto: the first that is installed)",
    },
}
"""Arguments of several commands."""


Arguments = argparse._ActionsContainer
"""A parser, or a group of its arguments."""


def add_shared(command: Arguments, *names: str) -> None:
    """Add arguments that several commands have, by their names in `SHARED`."""
    for name in names:
        command.add_argument(name, **SHARED[name])


class _Dropped(argparse.Action):
    """An option of earlier versions, whose use is an error that says what to do."""

    def __init__(self, remedy: str, **settings: Any):
        super().__init__(**settings, help=argparse.SUPPRESS)
        self._remedy = remedy

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> NoReturn:
        raise InputError(option_string, "is no option any more", self._remedy)


class Parser(argparse.ArgumentParser):
    """A parser that reports wrong arguments in one line, and exits with code 2."""

    declare: Callable[[Parser], None] | None = None
    """Adds the arguments, once they are needed."""

    def declared(self) -> Parser:
        """Return the parser with its arguments."""
        declare, self.declare = self.declare, None
        if declare is not None:
            declare(self)
        return self

    def shared(self, *names: str) -> None:
        """Add arguments that several commands have, by their names in `SHARED`."""
        add_shared(self, *names)

    def dropped(self, name: str, remedy: str, nargs: int | None = None) -> None:
        """Add an option of earlier versions, whose use is an InputError with this remedy."""
        self.add_argument(name, action=_Dropped, remedy=remedy, nargs=nargs)

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse arguments; the parser of all commands calls this function of the parser of one command."""
        return super(Parser, self.declared()).parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """End the process with one line about the arguments."""
        command = self.prog.partition(" ")[2] or "arguments"
        self.exit(2, f"jaxfit: {InputError(command, message, f'see `{self.prog} --help`')}\n")


CAMERAS = (
    "calibrated cameras: OpenCV .yaml, .xml or .json, anipose or Caliscope .toml, DANNCE .mat, JARVIS or Kalibr .yaml, "
    "COLMAP text"
)


def add_view_options(command: Arguments) -> None:
    """Add the options for the observations of several cameras."""
    add_shared(command, "--unit")
    text = "numbers with commas, one for each camera: its frame at frame 0 of the first camera, such as 0,3,-0.5"
    command.add_argument("--offsets", metavar="N,N,…", help=text)
    text = "which tracks are one bird: a table with the columns camera, track, bird (default: by the keypoints)"
    command.add_argument("--match", type=Path, metavar="TABLE.csv", help=text)


PLANE = "`birds`: from the birds that stand; `world`: z = 0 in the world of --cameras; or a table of measured distances"
PLANE += " with the columns x1_px, y1_px, x2_px, y2_px, distance_m"


def add_truth(command: Parser) -> None:
    text = "annotations (formats as of OBS), a folder of masks (for OBS only), or a scene"
    command.add_argument("--truth", type=Path, required=True, help=text)
    text = "match tracks with annotated birds by track id (ids) or by overlap; auto matches by overlap only if a track "
    text += "follows another bird than its id says (default %(default)s)"
    command.add_argument("--match", choices=("auto", "ids", "overlap"), default="auto", help=text)


def add_out(command: Parser, metavar: str, text: str, overwrite: str = "") -> None:
    """Add `--out`, and `--overwrite` if the command can replace what is there."""
    command.add_argument("--out", type=Path, required=True, metavar=metavar, help=text)
    if overwrite:
        command.add_argument("--overwrite", action="store_true", help=f"replace {overwrite}")


def add_observation_options(command: Parser, video: bool = True) -> None:
    """Add the options that files of other tracking programs may need."""
    text = "YAML file with lines `name in the file: name in the model` (default: names are mapped by their words)"
    command.add_argument("--names", type=Path, metavar="MAP.yaml", help=text)
    if video:
        text = "video (or folder of pictures) of the keypoints, for files that do not store the size of the images"
        command.add_argument("--video", type=Path, help=text)
        command.add_argument("--size", metavar="WxH", help="size of the images in pixels, in place of --video")
    else:
        command.set_defaults(size=None)


def add_cluster(command: Arguments, work: str = "fit windows") -> None:
    """Add the options that compute a part of the work in worker processes."""
    group = command.add_mutually_exclusive_group()
    text = f"{work} in N worker processes, which share the cores of this machine (extra `cluster`)"
    group.add_argument("--workers", type=int, metavar="N", help=text)
    text = f"{work} on the workers of a Dask cluster: address of its scheduler, or scheduler file (extra `cluster`)"
    group.add_argument("--scheduler", metavar="ADDRESS", help=text)


def add_tracking_options(command: Parser) -> None:
    """Add the video and the settings of tracking."""
    command.add_argument("video", type=Path, metavar="VIDEO", help="a video, or a folder of frames")
    text = "YAML file with `base: reconstruct` and changed settings; `jaxfit config show reconstruct` lists them all"
    command.add_argument("--config", default="reconstruct", help=text)
    from jaxfit.config.build import option_help
    from jaxfit.config.perception import TrackConfig

    for option, (path, details) in TRACK_OPTIONS.items():
        text = option_help(TrackConfig, path)
        command.add_argument(option, dest=f"track.{path}", help=text[0].lower() + text[1:], **details)


class AddEdit(argparse.Action):
    """Collects the corrections in the order of the command line."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        edits = [*(namespace.edits or []), ((option_string or "").lstrip("-"), values)]
        namespace.edits = edits
