"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from jaxfit.config.help import option_help
from jaxfit.config.perception import TrackConfig
from jaxfit.errors import InputError
from jaxfit.video.codecs import CODECS

__all__ = [
    "MODEL",
    "OBSERVATIONS",
    "Parser",
    "add_cluster",
    "add_codec",
    "add_command",
    "add_model",
    "add_observation_options",
    "add_out",
    "add_tracking_options",
    "add_truth",
]

MODEL = "`murre`, or a model file (.npz) that `jaxfit model import` writes"
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


class Parser(argparse.ArgumentParser):
    """A parser that reports wrong arguments in one line, and exits with code 2."""

    def error(self, message: str) -> NoReturn:
        command = self.prog.partition(" ")[2] or "arguments"
        self.exit(2, f"jaxfit: {InputError(command, message, f'see `{self.prog} --help`')}\n")


def add_command(commands: Any, name: str, run: str, text: str) -> argparse.ArgumentParser:
    """Add a command that calls the function `run` (`module.function` of `jaxfit.cli`)."""
    command = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
    command.set_defaults(run=run)
    return command


def add_model(command: argparse.ArgumentParser) -> None:
    command.add_argument("--model", default="murre", help=f"{MODEL} (default %(default)s)")


def add_truth(command: argparse.ArgumentParser) -> None:
    command.add_argument("--truth", type=Path, required=True, help="annotations (formats as of OBS), or a scene")
    text = "match tracks with annotated birds by track id (ids) or by overlap; auto matches by overlap only if a track "
    text += "follows another bird than its id says (default %(default)s)"
    command.add_argument("--match", choices=("auto", "ids", "overlap"), default="auto", help=text)


def add_out(command: argparse.ArgumentParser, metavar: str, text: str, overwrite: str = "") -> None:
    """Add `--out`, and `--overwrite` if the command can replace what is there."""
    command.add_argument("--out", type=Path, required=True, metavar=metavar, help=text)
    if overwrite:
        command.add_argument("--overwrite", action="store_true", help=f"replace {overwrite}")


def add_observation_options(command: argparse.ArgumentParser, video: bool = True) -> None:
    """Add the options that files of other tracking programs may need."""
    text = "YAML file with lines `name in the file: name in the model` (default: names are mapped by their words)"
    command.add_argument("--names", type=Path, metavar="MAP.yaml", help=text)
    if video:
        text = "video (or folder of pictures) of the keypoints, for files that do not store the size of the images"
        command.add_argument("--video", type=Path, help=text)
        command.add_argument("--size", metavar="WxH", help="size of the images in pixels, in place of --video")
    else:
        command.set_defaults(size=None)


def add_cluster(command: argparse.ArgumentParser, work: str = "fit windows") -> None:
    """Add the options that compute a part of the work in worker processes."""
    group = command.add_mutually_exclusive_group()
    text = f"{work} in N worker processes, which share the cores of this machine (extra `cluster`)"
    group.add_argument("--workers", type=int, metavar="N", help=text)
    text = f"{work} on the workers of a Dask cluster: address of its scheduler, or scheduler file (extra `cluster`)"
    group.add_argument("--scheduler", metavar="ADDRESS", help=text)


def add_force(command: argparse.ArgumentParser) -> None:
    text = "draw on the video even if it is not the video of the result (image size, number of frames, first frame)"
    command.add_argument("--force", action="store_true", help=text)


def add_codec(command: argparse.ArgumentParser) -> None:
    text = "codec of the video (default auto: the first that is installed)"
    command.add_argument("--codec", default="auto", choices=("auto", *CODECS), help=text)


def add_tracking_options(command: argparse.ArgumentParser) -> None:
    """Add the video and the settings of tracking."""
    command.add_argument("video", type=Path, metavar="VIDEO", help="a video, or a folder of frames")
    text = "YAML file with `base: reconstruct` and changed settings; `jaxfit config show reconstruct` lists them all"
    command.add_argument("--config", default="reconstruct", help=text)
    for option, (path, details) in TRACK_OPTIONS.items():
        text = option_help(TrackConfig, path)
        command.add_argument(option, dest=f"track.{path}", help=text[0].lower() + text[1:], **details)
