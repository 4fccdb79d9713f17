"""Arguments that several commands share, and those of results and species."""

from __future__ import annotations

import argparse
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

from jaxfit.config.build import option_help
from jaxfit.config.perception import TrackConfig
from jaxfit.export import FORMATS
from jaxfit.foundation.errors import InputError
from jaxfit.video import CODECS

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


CAMERAS = "calibrated cameras: OpenCV .yaml, .xml or .json, anipose .toml, DANNCE .mat, JARVIS .yaml, COLMAP text"


def add_unit(command: argparse.ArgumentParser) -> None:
    """Add the unit of length of a file of cameras."""
    text = "unit of length of the file (default: that of the file, or the usual one of the program)"
    command.add_argument("--unit", choices=("m", "cm", "mm"), help=text)


def add_view_options(command: argparse.ArgumentParser) -> None:
    """Add the options for the observations of several cameras."""
    add_unit(command)
    text = "numbers with commas, one for each camera: its frame at frame 0 of the first camera, such as 0,3,-0.5"
    command.add_argument("--offsets", metavar="N,N,…", help=text)
    text = "which tracks are one bird: a table with the columns camera, track, bird (default: by the keypoints)"
    command.add_argument("--match", type=Path, metavar="TABLE.csv", help=text)


def add_focal(command: argparse.ArgumentParser) -> None:
    """Add the focal length of an uncalibrated camera above a ledge."""
    text = "focal length of the camera in image pixels, without --cameras (default: estimated, with large errors)"
    command.add_argument("--focal-px", type=float, metavar="F", help=text)


PLANE = "`birds`: from the birds that stand; `world`: z = 0 in the world of --cameras; or a table of measured distances"
PLANE += " with the columns x1_px, y1_px, x2_px, y2_px, distance_m"


def add_truth(command: argparse.ArgumentParser) -> None:
    text = "annotations (formats as of OBS), a folder of masks (for OBS only), or a scene"
    command.add_argument("--truth", type=Path, required=True, help=text)
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
        command.add_argument(option, dest=f"track.{path}", help=_track_help(path), **details)


@cache  # several commands have the options, and `option_help` reads source code
def _track_help(path: str) -> str:
    text = option_help(TrackConfig, path)
    return text[0].lower() + text[1:]


def add_result_commands(commands: Any) -> None:
    """Add the commands."""
    _report(commands)
    _describe(commands)
    _view(commands)
    _export(commands)
    _tracks(commands)
    _join(commands)
    _ledge(commands)
    text = "check the installation: kernels, FFmpeg, codecs, networks, optional packages, cache"
    add_command(commands, "doctor", "doctor.doctor", text)


def _report(commands: Any) -> None:
    text = "write a report of a result as one HTML page: quality, warnings, pictures, timeline"
    report = add_command(commands, "report", "results.report", text)
    report.add_argument("result", type=Path, metavar="RESULT", help="folder of a result")
    text = "the footage, if the result does not name the footage, or the footage was moved"
    report.add_argument("--video", type=Path, help=text)
    text = "file to write (default: report.html in the folder of the result, which replaces an earlier report)"
    report.add_argument("--out", type=Path, metavar="HTML", help=text)
    report.add_argument("--overwrite", action="store_true", help="replace an existing file of --out")
    add_force(report)


def _describe(commands: Any) -> None:
    text = "describe what the birds of a result do: angles, wingbeats, distances, bouts of behaviour, time budgets"
    describe = add_command(commands, "describe", "behaviour.describe", text)
    describe.add_argument("result", type=Path, metavar="RESULT", help="folder of a result")
    text = "features of every bird and frame: .csv, .parquet, or .nc for movement; bouts, time budgets and a project "
    add_out(describe, "PATH", text + "for BORIS stand beside it", overwrite="existing files")
    text = "rules of the behaviours: a file with `base: behaviour` (default: the shipped rules)"
    describe.add_argument("--config", default="behaviour", metavar="FILE", help=text)
    text = "also this feature: the name that a package registers, or module:function"
    describe.add_argument("--feature", action="append", metavar="NAME", help=text)
    describe.add_argument("--tracks", metavar="ID,ID", help="only these tracks")
    describe.add_argument("--frames", metavar="A:B", help="only the frames from A to B; B is left out")
    describe.add_argument("--fps", type=float, help="frame rate of the footage (default: that of the result)")


def _view(commands: Any) -> None:
    text = "look at a result in the browser: film, birds on their ledge, timeline; correct its tracks"
    view = add_command(commands, "view", "view.view", text)
    text = "folder of a result; several results of one film are shown side by side"
    view.add_argument("results", type=Path, nargs="+", metavar="RESULT", help=text)
    text = "film of the result (default: the film that the result names, if it is still there)"
    view.add_argument("--video", type=Path, metavar="VIDEO|DIR", help=text)
    text = "for a result in a world: the camera of the film, by its name in cameras.toml (default: the first camera)"
    view.add_argument("--camera", metavar="NAME", help=text)
    text = "the file that was fitted, for a result of `jaxfit fit`"
    view.add_argument("--observations", type=Path, metavar="OBS.json", help=text)
    view.add_argument("--frames", metavar="A:B", help="only the frames from A to B; B is left out")
    view.add_argument("--fps", type=float, help="frame rate of the footage (default: that of the result)")
    text = "file of the corrections, which `jaxfit tracks --edits` takes too (default: RESULT.edits beside the result)"
    view.add_argument("--edits", type=Path, metavar="FILE", help=text)
    view.add_argument("--port", type=int, metavar="PORT", help="port to listen on (default: a free port)")
    view.add_argument("--no-browser", action="store_true", help="print the address, and open no browser")
    text = "write a page that opens without jaxfit: one file of up to 30 MB (.html), or a folder"
    view.add_argument("--save", type=Path, metavar="PAGE.html|DIR", help=text)
    view.add_argument("--overwrite", action="store_true", help="replace an earlier page of --save")
    add_force(view)


def _export(commands: Any) -> None:
    text = "write a result in a format that other tools open"
    export = add_command(commands, "export", "results.export", text)
    export.add_argument("result", type=Path, metavar="RESULT", help="folder of a result")
    tools = "; ".join(f"{name} ({form.tools})" for name, form in FORMATS.items())
    export.add_argument("--to", required=True, choices=tuple(FORMATS), metavar="FORMAT", help=f"format: {tools}")
    text = "file to write; a folder for nwb, and for glb unless the name ends with .glb"
    add_out(export, "PATH", text, overwrite="existing files, or an earlier export in the folder")
    export.add_argument("--tracks", metavar="ID,ID", help="only these tracks")
    text = "only the frames from number A to number B − 1; A or B may be left out"
    export.add_argument("--frames", metavar="A:B", help=text)
    text = "frame rate of the footage, if the result does not hold the rate, or holds a wrong rate"
    export.add_argument("--fps", type=float, help=text)
    text = "length of a model unit in metres, for models that do not state the length"
    export.add_argument("--metres-per-unit", type=float, metavar="M", help=text)
    text = "the footage, if the result does not name the footage, or the footage was moved"
    export.add_argument("--video", type=Path, help=text)
    text = (
        "movement: keypoints in image pixels (2d, the default), in the camera frame (3d) or in the world of the result"
    )
    export.add_argument("--space", choices=("2d", "3d", "world"), help=text)
    text = "movement: names of the dimensions; plural for movement before 0.17 (default singular)"
    export.add_argument("--dims", choices=("singular", "plural"), help=text)
    text = "nwb: time of frame 0 of the footage, such as 2024-06-01T12:00:00+02:00"
    export.add_argument("--start", metavar="TIME", help=text)
    text = "glb: add the ground: the ledge of the result, or else a level ground below the feet of the birds"
    export.add_argument("--ground", action="store_true", help=text)


class _AddEdit(argparse.Action):
    """Collects the corrections in the order of the command line."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: str | None = None) -> None:
        edits = [*(namespace.edits or []), ((option_string or "").lstrip("-"), values)]
        namespace.edits = edits


def _tracks(commands: Any) -> None:
    text = "list the tracks of a result, or correct the tracks and fit only the windows that change"
    tracks = add_command(commands, "tracks", "results.tracks", text)
    tracks.add_argument("result", type=Path, metavar="RESULT", help="folder of a result")
    for option, metavar, what in (
        ("--swap", "ID,ID@A:B", "exchange two tracks, from frame A to frame B − 1 (or to the end, or everywhere)"),
        ("--cut", "ID@A", "the frames from A on become a new track"),
        ("--join", "ID,ID", "the second track becomes a part of the first track"),
        ("--delete", "ID,ID", "delete tracks"),
        ("--exclude", "ID@A:B", "remove wrong poses of a track, from frame A to frame B − 1 (or to the end)"),
    ):
        text = f"{what}; may be repeated, corrections happen in their order"
        tracks.add_argument(option, dest="edits", action=_AddEdit, metavar=metavar, help=text)
    text = "text file of corrections, one a line, such as `swap 3,5@120:200` or `exclude 3@10:20`; lines that begin "
    text += "with # are ignored; these corrections come before those of the options"
    tracks.add_argument("--edits", dest="edits_file", type=Path, metavar="FILE", help=text)
    text = "the file that was fitted, for a result of `jaxfit fit`"
    tracks.add_argument("--observations", type=Path, metavar="OBS.json", help=text)
    tracks.add_argument("--out", type=Path, metavar="DIR", help="folder for the corrected result")
    text = "replace an earlier result in the folder of --out"
    tracks.add_argument("--overwrite", action="store_true", help=text)


def _join(commands: Any) -> None:
    text = "join the results of ranges of one video, and continue tracks across the cuts by place and size"
    join = add_command(commands, "join", "results.join", text)
    text = "folders of `jaxfit reconstruct --start A --stop B`, in any order"
    join.add_argument("results", type=Path, nargs="+", metavar="RESULT", help=text)
    text = "a track may continue after so many frames without the bird (default: the memory of the tracker)"
    join.add_argument("--bridge", type=int, metavar="FRAMES", help=text)
    add_out(join, "DIR", "folder for the joined result", overwrite="an earlier result in the folder")


def _ledge(commands: Any) -> None:
    text = "place the birds of a result on the ledge that they stand on, in a world in metres"
    ledge = add_command(commands, "ledge", "ledge.ledge", text)
    ledge.add_argument("result", type=Path, metavar="RESULT", help="folder of a result of one camera")
    ledge.add_argument("--plane", default="birds", dest="ledge", metavar="PLANE", help=f"{PLANE} (default birds)")
    ledge.add_argument(
        "--cameras", type=Path, metavar="FILE", help=f"the calibrated camera, without distortion; {CAMERAS}"
    )
    add_unit(ledge)
    add_focal(ledge)
    add_out(ledge, "DIR", "folder for the new result", overwrite="an earlier result in the folder")


def add_adapt_commands(commands: Any) -> None:
    """Add `jaxfit adapt scan` and `jaxfit adapt photos`."""
    adapt = commands.add_parser("adapt", help="adapt a bird model to a species")
    actions = adapt.add_subparsers(required=True, metavar="ACTION")
    scan = add_command(actions, "scan", "species.adapt_scan", "fit bone lengths and shape of a model to a 3D scan")
    scan.add_argument("scan", type=Path, metavar="SCAN", help="scan as a triangle mesh (.ply, .obj, .stl, .glb)")
    text = "annotated keypoints: JSON of names with vertex numbers or points, or picked points of MeshLab (.pp)"
    scan.add_argument("--keypoints", type=Path, required=True, metavar="K.json", help=text)
    scan.add_argument("--model", default="murre", metavar="BASE", help=f"model to start from: {MODEL} (default murre)")
    add_out(scan, "M.npz", "model file to write, and its picture")
    text = "also move the vertices by a smooth, left-right symmetric offset: for shapes outside the model's shape space"
    scan.add_argument("--offset", action="store_true", help=text)
    text = "axis of the scan that points up (X, Y, Z, -X, …): helps the start, and is checked"
    scan.add_argument(
        "--up", type=str.upper, choices=[s + a for s in ("", "-") for a in "XYZ"], metavar="AXIS", help=text
    )
    text = "unit of the scan, for errors in mm; the size of the model is free (default %(default)s)"
    scan.add_argument("--unit", choices=("mm", "cm", "m"), default="cm", help=text)
    _photos(actions)


def _photos(actions: Any) -> None:
    text = "fit the mean bone lengths and the mean shape of a species to photographs"
    photos = add_command(actions, "photos", "species.adapt_photos", text)
    text = "keypoints and masks of photographs or tracks (COCO, or files of other programs)"
    photos.add_argument("birds", type=Path, nargs="+", metavar="BIRDS.json", help=text)
    photos.add_argument("--model", default="murre", metavar="M", help=f"model to start from: {MODEL} (default murre)")
    add_out(photos, "N.npz", "model file to write")
    text = "parts that stay as in the model: bones, shape, offset, or several with commas"
    photos.add_argument("--fix", default="", metavar="PARTS", help=text)
    text = "largest number of images of a track, which shows one individual: images at equal distances (default "
    text += "%(default)s)"
    photos.add_argument("--frames-per-track", type=int, default=10, metavar="N", help=text)
    add_observation_options(photos)


def add_model_commands(actions: Any) -> None:
    """Add `jaxfit model compare`, `rig` and `keypoints`."""
    compare = add_command(actions, "compare", "species.model_compare", "compare bones and surfaces of two models")
    for name in ("first", "second"):
        compare.add_argument(name, metavar=name[0].upper() + name[1:], help=MODEL)
    text = "picture of both models from six sides, coloured by their distance"
    compare.add_argument("--out", type=Path, metavar="PNG", help=text)
    compare.add_argument("--json", action="store_true", help="print JSON instead of a table")
    text = "transfer joints, skin weights and keypoints of a model to a mesh, so that the mesh can be posed"
    rig = add_command(actions, "rig", "species.model_rig", text)
    rig.add_argument("mesh", type=Path, metavar="MESH", help="triangle mesh (.ply, .obj, .stl, .glb), such as a scan")
    text = "model that lies on the mesh: a model that `jaxfit adapt scan` wrote for this scan, or a model "
    text += "in whose rest pose the mesh is"
    rig.add_argument("--like", type=Path, required=True, metavar="MODEL", help=text)
    add_out(rig, "M.npz", "model file to write")
    text = "write a page (.html) that shows annotators where each keypoint sits"
    keypoints = add_command(actions, "keypoints", "species.model_keypoints", text)
    keypoints.add_argument("file", metavar="MODEL", help=MODEL)
    add_out(keypoints, "PAGE.html", "page to write")
