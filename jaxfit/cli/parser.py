"""The commands by group, and the arguments of every command.

A command names its function as `module.function` of `jaxfit.cli`, whose module is imported when the command runs. The
arguments of a command are declared when they are needed, so that `--help` and wrong arguments need no other library.
"""

from __future__ import annotations

import argparse
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from jaxfit.cli.arguments import (
    CAMERAS,
    MODEL,
    OBSERVATIONS,
    PLANE,
    AddEdit,
    Parser,
    add_cluster,
    add_observation_options,
    add_out,
    add_shared,
    add_tracking_options,
    add_truth,
    add_view_options,
)
from jaxfit.export import FORMATS
from jaxfit.foundation.extras import own_version

Declare = Callable[[Parser], None]


class Command(NamedTuple):
    """A command of the command line."""

    run: str
    """The function: `module.function` of `jaxfit.cli`."""
    text: str
    declare: Declare
    """Adds the arguments."""


COMMANDS: dict[str, dict[str, Command]] = {}
"""Group → command → its function, description and arguments."""
_FAMILIES = {
    "adapt": "adapt a bird model to a species",
    "cameras": "calibrate, describe and check cameras",
    "config": "list the configs and print their settings",
    "dataset": "convert published data sets",
    "model": "download, import, describe and draw bird models",
    "networks": "download published networks",
    "prior": "learn a prior of poses from results",
}
"""First word of the commands of two words → its description."""


def _command(group: str, name: str, run: str) -> Callable[[Declare], Declare]:
    """Register a command, whose description is the docstring of the function that declares its arguments."""

    def register(declare: Declare) -> Declare:
        text = " ".join((declare.__doc__ or "").split())
        COMMANDS.setdefault(group, {})[name] = Command(run, text, declare)
        return declare

    return register


@_command("start", "demo", "demo.demo")
def _demo(command: Parser) -> None:
    """Simulate a short scene, reconstruct the scene from its footage, and measure the result."""
    text = "folder for all files (default %(default)s)"
    command.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help=text)
    text = "also print all tables, which are in the report too, and messages of libraries"
    # without a default, so that `jaxfit --verbose demo` stays verbose
    command.add_argument("-v", "--verbose", action="store_true", default=argparse.SUPPRESS, help=text)


@_command("start", "reconstruct", "perception.reconstruct")
def _reconstruct(command: Parser) -> None:
    """Track the birds of a video, fit their poses and draw them."""
    add_tracking_options(command)
    text = "keypoints that you marked in a few frames (formats as OBS of `jaxfit fit`); optical flow carries them to "
    text += "the other frames, and no keypoint network runs; without --config, the fit is that of `few_labels`"
    command.add_argument("--labels", type=Path, metavar="LABELS", help=text)
    text = "masks in place of a segmenter: a folder of pictures in which every grey value is one bird, or a COCO file"
    command.add_argument("--masks", type=Path, metavar="MASKS", help=text)
    command.shared("--model")
    add_cluster(command, "run the networks and fit windows")
    add_out(command, "DIR", "folder for the result", overwrite="an earlier result in the folder")


@_command("start", "report", "results.report")
def _report(command: Parser) -> None:
    """Write a report of a result as one HTML page: quality, warnings, pictures, timeline."""
    command.shared("result")
    command.shared("--video")
    text = "file to write (default: report.html in the folder of the result, which replaces an earlier report)"
    command.add_argument("--out", type=Path, metavar="HTML", help=text)
    command.add_argument("--overwrite", action="store_true", help="replace an existing file of --out")
    command.shared("--force")


@_command("start", "view", "view.view")
def _view(command: Parser) -> None:
    """Look at a result in the browser: film, birds on their ledge, timeline; correct its tracks."""
    text = "folder of a result; several results of one film are shown side by side"
    command.add_argument("results", type=Path, nargs="+", metavar="RESULT", help=text)
    text = "film of the result (default: the film that the result names, if it is still there)"
    command.add_argument("--video", type=Path, metavar="VIDEO|DIR", help=text)
    command.shared("--camera", "--observations", "--frames", "--fps")
    text = "file of the corrections, which `jaxfit tracks --edits` takes too (default: RESULT.edits beside the result)"
    command.add_argument("--edits", type=Path, metavar="FILE", help=text)
    _add_server(command)
    text = "write a page that opens without jaxfit: one file of up to 30 MB (.html), or a folder"
    command.add_argument("--save", type=Path, metavar="PAGE.html|DIR", help=text)
    command.add_argument("--overwrite", action="store_true", help="replace an earlier page of --save")
    command.shared("--force")


def _add_server(command: Parser) -> None:
    command.add_argument("--port", type=int, metavar="PORT", help="port to listen on (default: a free port)")
    command.add_argument("--no-browser", action="store_true", help="print the address, and open no browser")


@_command("start", "describe", "behaviour.describe")
def _describe(command: Parser) -> None:
    """Describe what the birds of a result do: angles, wingbeats, distances, bouts of behaviour, time budgets."""
    command.shared("result")
    text = "features of every bird and frame: .csv, .parquet, or .nc for movement; bouts, time budgets and a project "
    add_out(command, "PATH", text + "for BORIS are written to the same folder", overwrite="existing files")
    text = "rules of the behaviours: a file with `base: behaviour` (default: the shipped rules)"
    command.add_argument("--config", default="behaviour", metavar="FILE", help=text)
    text = "also this feature: the name that a package registers, or module:function"
    command.add_argument("--feature", action="append", metavar="NAME", help=text)
    command.shared("--tracks", "--frames", "--fps")


@_command("start", "doctor", "doctor.doctor")
def _doctor(command: Parser) -> None:
    """Check the installation: kernels, FFmpeg, codecs, networks, optional packages, cache."""


@_command("correct", "suggest", "perception.suggest_frames")
def _suggest(command: Parser) -> None:
    """Choose frames that a person should label, and write their pictures and pre-filled labels (extra `formats`)."""
    add_tracking_options(command)
    text = "result of this video, instead of tracking: a folder of reconstruct or fit, or a file of keypoints (as OBS)"
    command.add_argument("--result", type=Path, metavar="DIR|OBS", help=text)
    command.add_argument("--count", type=int, default=40, help="number of frames (default %(default)s)")
    text = "second segmenter, such as `general`: suggest the frames in which its masks differ most from the others"
    command.add_argument("--teacher", metavar="NAME", help=text)
    command.add_argument("--empty", action="store_true", help="write no labels, for footage with low trust")
    add_out(command, "DIR", "folder for the pictures and labels", overwrite="earlier suggestions in the folder")


@_command("correct", "label", "view.label")
def _label(command: Parser) -> None:
    """Label keypoints of birds in some frames of a film, in the browser, for reconstruct --labels and train."""
    command.add_argument("video", type=Path, metavar="VIDEO", help="a video, or a folder of frames")
    command.add_argument("--count", type=int, default=10, help="number of frames (default %(default)s)")
    command.add_argument(
        "--birds", type=int, default=5, help="largest number of birds in a frame (default %(default)s)"
    )
    command.shared("--model")
    text = "COCO file of the labels, which the next start continues (default: VIDEO.labels.json beside the video)"
    command.add_argument("--out", type=Path, metavar="FILE.json", help=text)
    _add_server(command)


@_command("correct", "train", "training.train")
def _train(command: Parser) -> None:
    """Train a network on labelled footage, or a built-in network again (needs the extra `train`)."""
    command.add_argument("network", choices=("segmenter", "keypoints", "outline"), help="network to train")
    text = "outline: also species of this model, two in three (default: murres only)"
    command.add_argument("--model", metavar="MODEL", help=text)
    add_out(command, "N.onnx", "network file to write", overwrite="an existing file")
    text = f"labelled frames: {OBSERVATIONS}; for a segmenter also COCO masks without keypoints, or folders of masks"
    command.add_argument("--labels", type=Path, nargs="+", metavar="FILE", help=text)
    text = "video or folder of the labelled frames, one for all files or one for each (default: beside the labels)"
    command.add_argument("--images", type=Path, nargs="+", metavar="DIR|VIDEO", help=text)
    text = "masks of the labelled birds: a folder of pictures, or a COCO file"
    command.add_argument("--masks", type=Path, metavar="DIR|OBS.json", help=text)
    text = "segmenter without labels: film in which the teacher makes the labels"
    command.add_argument("--video", type=Path, metavar="VIDEO|DIR", help=text)
    text = "segmenter that makes the labels of --video, or tracks the masks of --labels to other frames of their film: "
    text += "`general`, A.onnx+B.onnx, `none`, or `auto`: `general` if its files exist (default %(default)s)"
    command.add_argument("--teacher", default="auto", metavar="NAME", help=text)
    text = "network to start from: `builtin`, or a network that this command wrote (default: builtin with labels, else "
    text += "random weights)"
    command.add_argument("--base", metavar="N.onnx", help=text)
    text = "share of the labelled frames for the check of the result; 0 trains without a check (default %(default)s)"
    command.add_argument("--holdout", type=float, default=0.2, metavar="SHARE", help=text)
    text = "folder of simulated scenes; absent scenes are filmed before the training "
    text += "(default: simulated_frames with labels, else training_frames, 5 GB)"
    command.add_argument("--frames", type=Path, metavar="DIR", help=text)
    command.add_argument(
        "--scenes", type=int, help="simulated scenes, of 10 frames each (default: 20 with labels, else 160)"
    )
    text = "without labels: share of scenes with other birds in other landscapes (default %(default)s)"
    command.add_argument("--varied", type=float, default=0.0, metavar="SHARE", help=text)
    text = "without labels: share of scenes in which the birds flap or fly (default %(default)s)"
    command.add_argument("--wings", type=float, default=0.0, metavar="SHARE", help=text)
    text = "leave it out: a segmenter starts from the encoder of the built-in segmenter; or give --base"
    command.dropped("--encoder", text)
    command.add_argument("--steps", type=int, help="number of training steps (default: by the number of labels)")
    command.add_argument("--seed", type=int, default=0, help="seed of new weights and of samples (default %(default)s)")


@_command("correct", "tracks", "results.tracks")
def _tracks(command: Parser) -> None:
    """List the tracks of a result, or correct the tracks and fit only the windows that change."""
    command.shared("result")
    for option, metavar, what in (
        ("--swap", "ID,ID@A:B", "exchange two tracks, from frame A to frame B − 1 (or to the end, or everywhere)"),
        ("--cut", "ID@A", "the frames from A on become a new track"),
        ("--join", "ID,ID", "the second track becomes a part of the first track"),
        ("--delete", "ID,ID", "delete tracks"),
        ("--exclude", "ID@A:B", "remove wrong poses of a track, from frame A to frame B − 1 (or to the end)"),
    ):
        text = f"{what}; may be repeated, corrections happen in their order"
        command.add_argument(option, dest="edits", action=AddEdit, metavar=metavar, help=text)
    text = "text file of corrections, one a line, such as `swap 3,5@120:200` or `exclude 3@10:20`; lines that begin "
    text += "with # are ignored; these corrections come before those of the options"
    command.add_argument("--edits", dest="edits_file", type=Path, metavar="FILE", help=text)
    command.shared("--observations")
    command.add_argument("--out", type=Path, metavar="DIR", help="folder for the corrected result")
    text = "replace an earlier result in the folder of --out"
    command.add_argument("--overwrite", action="store_true", help=text)


@_command("correct", "join", "results.join")
def _join(command: Parser) -> None:
    """Join the results of ranges of one video, and continue tracks across the cuts by place and size."""
    text = "folders of `jaxfit reconstruct --start A --stop B`, in any order"
    command.add_argument("results", type=Path, nargs="+", metavar="RESULT", help=text)
    text = "a track may continue after so many frames without the bird (default: the memory of the tracker)"
    command.add_argument("--bridge", type=int, metavar="FRAMES", help=text)
    add_out(command, "DIR", "folder for the joined result", overwrite="an earlier result in the folder")


@_command("export", "export", "results.export")
def _export(command: Parser) -> None:
    """Write a result in a format that other tools open."""
    command.shared("result")
    tools = "; ".join(f"{name} ({form.tools})" for name, form in FORMATS.items())
    command.add_argument("--to", required=True, choices=tuple(FORMATS), metavar="FORMAT", help=f"format: {tools}")
    text = "file to write; a folder for nwb, and for glb unless the name ends with .glb"
    add_out(command, "PATH", text, overwrite="existing files, or an earlier export in the folder")
    command.shared("--tracks")
    text = "only the frames from number A to number B − 1; A or B may be left out"
    command.add_argument("--frames", metavar="A:B", help=text)
    text = "frame rate of the footage, if the result does not hold the rate, or holds a wrong rate"
    command.add_argument("--fps", type=float, help=text)
    text = "length of a model unit in metres, for models that do not state the length"
    command.add_argument("--metres-per-unit", type=float, metavar="M", help=text)
    command.shared("--video")
    text = (
        "movement: keypoints in image pixels (2d, the default), in the camera frame (3d) or in the world of the result"
    )
    command.add_argument("--space", choices=("2d", "3d", "world"), help=text)
    text = "movement: names of the dimensions; plural for movement before 0.17 (default singular)"
    command.add_argument("--dims", choices=("singular", "plural"), help=text)
    text = "nwb: time of frame 0 of the footage, such as 2024-06-01T12:00:00+02:00"
    command.add_argument("--start", metavar="TIME", help=text)
    text = "glb: add the ground: the ledge of the result, or else a level ground below the feet of the birds"
    command.add_argument("--ground", action="store_true", help=text)


@_command("export", "overlay", "fitting.overlay")
def _overlay(command: Parser) -> None:
    """Draw a result on its video."""
    command.add_argument("result", type=Path, metavar="DIR", help="folder of a result")
    command.add_argument("--video", type=Path, required=True, help="the video (or folder of frames) of the result")
    command.shared("--camera")
    add_out(
        command, "FILE", "video to write; the same folder receives a contact sheet (.png)", overwrite="existing files"
    )
    command.add_argument("--observations", type=Path, metavar="OBS", help="also draw the detected keypoints")
    add_observation_options(command, video=False)
    command.add_argument("--side-views", action="store_true", help="also show every bird from its side")
    command.add_argument("--frame", type=int, help="draw only this frame, as a picture (.png or .jpg)")
    command.shared("--force", "--codec")


@_command("single steps", "track", "perception.track")
def _track(command: Parser) -> None:
    """Detect and track the birds of a video and their keypoints."""
    add_tracking_options(command)
    text = "VIDEO is a folder of photographs: search the bird of each picture, without tracks"
    command.add_argument("--photographs", action="store_true", help=text)
    add_out(command, "OBS.json", "COCO file to write", overwrite="an existing file")
    add_cluster(command, "run the networks")


@_command("single steps", "import", "observations.import_observations")
def _import(command: Parser) -> None:
    """Convert keypoints of DeepLabCut, SLEAP, Lightning Pose, CVAT or Label Studio to a COCO file."""
    command.add_argument("file", type=Path, metavar="FILE", help=OBSERVATIONS)
    add_out(command, "OBS.json", "COCO file to write", overwrite="an existing file")
    add_observation_options(command)
    text = "masks of the birds: a folder of pictures, one for every frame, or a COCO file"
    command.add_argument("--masks", type=Path, metavar="DIR|OBS.json", help=text)
    command.shared("--model")


@_command("single steps", "fit", "fitting.fit")
def _fit(command: Parser) -> None:
    """Fit the poses of birds to keypoints and masks."""
    text = f"{OBSERVATIONS}; with --cameras one file for each camera"
    command.add_argument("observations", type=Path, nargs="+", metavar="OBS", help=text)
    add_out(command, "DIR", "folder for the result", overwrite="an earlier result in the folder")
    command.shared("--model")
    text = "name of a shipped config (paper, baseline, …) or a YAML file (default %(default)s)"
    command.add_argument("--config", default="paper", help=text)
    add_observation_options(command)
    group = command.add_argument_group("calibrated cameras")
    group.add_argument("--cameras", type=Path, metavar="FILE", help=f"fit all views at once, in the world; {CAMERAS}")
    add_view_options(group)
    group = command.add_argument_group("the ledge")
    text = f"place the birds on the ledge that they stand on, in a world in metres; PLANE is {PLANE} (default birds)"
    group.add_argument("--ledge", nargs="?", const="birds", metavar="PLANE", help=text)
    add_shared(group, "--focal-px")
    group = command.add_argument_group("start and speed of the fit")
    text = "result that knows the bodies of the birds; tracks of the same number keep their body"
    group.add_argument("--body", type=Path, metavar="RESULT", help=text)
    text = "initial poses: the output of a pose regressor, or an earlier poses.npz"
    group.add_argument("--init", type=Path, metavar="POSES.npz", help=text)
    add_cluster(group)


@_command("single steps", "ledge", "ledge.ledge")
def _ledge(command: Parser) -> None:
    """Place the birds of a result on the ledge that they stand on, in a world in metres."""
    command.add_argument("result", type=Path, metavar="RESULT", help="folder of a result of one camera")
    command.add_argument("--plane", default="birds", dest="ledge", metavar="PLANE", help=f"{PLANE} (default birds)")
    command.add_argument(
        "--cameras", type=Path, metavar="FILE", help=f"the calibrated camera, without distortion; {CAMERAS}"
    )
    command.shared("--unit", "--focal-px")
    add_out(command, "DIR", "folder for the new result", overwrite="an earlier result in the folder")


@_command("single steps", "config list", "models.list_configs")
def _config_list(command: Parser) -> None:
    """List the configs of fits: what each config is for, and the data on which its values were chosen."""


@_command("single steps", "config show", "models.show_config")
def _config_show(command: Parser) -> None:
    """Print all settings of a config with their descriptions."""
    command.add_argument(
        "name", metavar="NAME", help="shipped config (reconstruct, paper, …) or file of behaviour rules"
    )


@_command("cameras and models", "cameras calibrate", "calibrate.calibrate_films")
def _cameras_calibrate(command: Parser) -> None:
    """Calibrate cameras from films of a checkerboard that started together, and write them as anipose TOML."""
    text = "one video or folder of pictures for each camera; its name is the name of the camera"
    command.add_argument("films", type=Path, nargs="+", metavar="FILM", help=text)
    text = "inner corners of the board, which are one less than the squares in each direction, such as 9x6"
    command.add_argument("--board", required=True, metavar="COLSxROWS", help=text)
    command.add_argument("--square-mm", type=float, required=True, metavar="MM", help="side of a square of the board")
    command.add_argument("--fisheye", action="store_true", help="the lenses are fisheye lenses")
    add_out(command, "CAMERAS.toml", "file to write", overwrite="an existing file")


@_command("cameras and models", "cameras show", "cameras.show_cameras")
def _cameras_show(command: Parser) -> None:
    """Print the lens and the position of every camera, and draw their fields of view."""
    command.add_argument("cameras", type=Path, metavar="FILE", help=CAMERAS)
    command.shared("--unit")
    command.add_argument(
        "--out", type=Path, metavar="PNG", help="picture to write: the cameras from above and from the side"
    )
    command.add_argument("--overwrite", action="store_true", help="replace an existing file")


@_command("cameras and models", "cameras check", "cameras.check_calibration")
def _cameras_check(command: Parser) -> None:
    """Check cameras against the keypoints of birds: errors, wrong order, offset in time, moved camera."""
    command.add_argument("cameras", type=Path, metavar="FILE", help=CAMERAS)
    text = f"one file for each camera, in the order of the cameras or with their names: {OBSERVATIONS}"
    command.add_argument("observations", type=Path, nargs="+", metavar="OBS", help=text)
    add_observation_options(command)
    add_view_options(command)
    command.shared("--model")


@_command("cameras and models", "model import", "models.model_import")
def _model_import(command: Parser) -> None:
    """Import a published model."""
    command.add_argument("kind", choices=("avian-mesh", "aves"), help="kind of model")
    command.add_argument("sources", type=Path, nargs="+", help="files of the model, or the folder that holds them")
    text = (
        "length of the species from bill tip to tail tip, which sets the unit of the model (several cameras measure it)"
    )
    command.add_argument("--length-cm", type=float, metavar="CM", help=text)
    add_out(command, "M.npz", "model file to write")


@_command("cameras and models", "model get", "models.model_get")
def _model_get(command: Parser) -> None:
    """Download a published model; `--model` takes its name then."""
    command.add_argument("name", choices=("aves",), help="AVES: birds of many species (MIT licence, 1.8 MB)")
    command.shared("--from")


@_command("cameras and models", "networks get", "models.networks_get")
def _networks_get(command: Parser) -> None:
    """Download published networks."""
    text = "the segmenter of birds of any species, U²-Net-p with YOLOX-nano (8.2 MB), YOLOX-tiny (25 MB) or YOLOX-s "
    command.add_argument("name", choices=("general", "general-tiny", "general-s"), help=f"{text}(40 MB); Apache-2.0")
    command.shared("--from")


@_command("cameras and models", "model info", "models.model_info")
def _model_info(command: Parser) -> None:
    """Describe a model."""
    command.add_argument("file", metavar="MODEL", help=MODEL)
    command.shared("--json")


@_command("cameras and models", "model view", "models.model_view")
def _model_view(command: Parser) -> None:
    """Draw a model from six sides."""
    command.add_argument("file", metavar="MODEL", help=MODEL)
    add_out(command, "PNG", "picture to write")
    text = "posture of the murre: standing, incubating, … (default standing; other models have only the rest pose)"
    command.add_argument("--posture", help=text)


@_command("cameras and models", "model compare", "species.model_compare")
def _model_compare(command: Parser) -> None:
    """Compare bones and surfaces of two models."""
    for name in ("first", "second"):
        command.add_argument(name, metavar=name[0].upper() + name[1:], help=MODEL)
    text = "picture of both models from six sides, coloured by their distance"
    command.add_argument("--out", type=Path, metavar="PNG", help=text)
    command.shared("--json")


@_command("cameras and models", "model rig", "species.model_rig")
def _model_rig(command: Parser) -> None:
    """Transfer joints, skin weights and keypoints of a model to a mesh, so that the mesh can be posed."""
    command.add_argument(
        "mesh", type=Path, metavar="MESH", help="triangle mesh (.ply, .obj, .stl, .glb), such as a scan"
    )
    text = "model that lies on the mesh: a model that `jaxfit adapt scan` wrote for this scan, or a model "
    text += "in whose rest pose the mesh is"
    command.add_argument("--like", type=Path, required=True, metavar="MODEL", help=text)
    add_out(command, "M.npz", "model file to write")


@_command("cameras and models", "model keypoints", "species.model_keypoints")
def _model_keypoints(command: Parser) -> None:
    """Write a page (.html) that shows annotators where each keypoint sits."""
    command.add_argument("file", metavar="MODEL", help=MODEL)
    add_out(command, "PAGE.html", "page to write")


@_command("cameras and models", "adapt scan", "species.adapt_scan")
def _adapt_scan(command: Parser) -> None:
    """Fit bone lengths and shape of a model to a 3D scan."""
    command.add_argument("scan", type=Path, metavar="SCAN", help="scan as a triangle mesh (.ply, .obj, .stl, .glb)")
    text = "annotated keypoints: JSON of names with vertex numbers or points, or picked points of MeshLab (.pp)"
    command.add_argument("--keypoints", type=Path, required=True, metavar="K.json", help=text)
    command.add_argument(
        "--model", default="murre", metavar="BASE", help=f"model to start from: {MODEL} (default murre)"
    )
    add_out(command, "M.npz", "model file to write, and its picture")
    text = "also move the vertices by a smooth, left-right symmetric offset: for shapes outside the model's shape space"
    command.add_argument("--offset", action="store_true", help=text)
    text = "axis of the scan that points up (X, Y, Z, -X, …): helps the start, and is checked"
    command.add_argument(
        "--up", type=str.upper, choices=[s + a for s in ("", "-") for a in "XYZ"], metavar="AXIS", help=text
    )
    text = "unit of the scan, for errors in mm; the size of the model is free (default %(default)s)"
    command.add_argument("--unit", choices=("mm", "cm", "m"), default="cm", help=text)


@_command("cameras and models", "adapt photos", "species.adapt_photos")
def _adapt_photos(command: Parser) -> None:
    """Fit the mean bone lengths and the mean shape of a species to photographs."""
    text = "keypoints and masks of photographs or tracks (COCO, or files of other programs)"
    command.add_argument("birds", type=Path, nargs="+", metavar="BIRDS.json", help=text)
    command.add_argument("--model", default="murre", metavar="M", help=f"model to start from: {MODEL} (default murre)")
    add_out(command, "N.npz", "model file to write")
    text = "parts that stay as in the model: bones, shape, offset, or several with commas"
    command.add_argument("--fix", default="", metavar="PARTS", help=text)
    text = "largest number of images of a track, which shows one individual: images at equal distances (default "
    text += "%(default)s)"
    command.add_argument("--frames-per-track", type=int, default=10, metavar="N", help=text)
    add_observation_options(command)


@_command("cameras and models", "prior learn", "models.prior_learn")
def _prior_learn(command: Parser) -> None:
    """Learn a pose prior from the poses of results and write a model with this prior."""
    command.add_argument("results", type=Path, nargs="+", metavar="RESULTS", help="result folders of fits of one model")
    text = "set terms.motion_likelihood in a config, as `jaxfit config show map` prints it"
    command.dropped("--motion", text, nargs=0)
    add_out(command, "P.npz", "model file to write, for `--model`")


@_command("research", "simulate", "demo.simulate_scene")
def _simulate(command: Parser) -> None:
    """Film simulated murres on a ledge and store the ground truth."""
    add_out(command, "SCENE", "folder for the scene", overwrite="an earlier scene in the folder")
    command.add_argument("--birds", type=int, default=7, help="number of birds (default %(default)s)")
    command.add_argument("--frames", type=int, default=100, help="number of frames (default %(default)s)")
    command.add_argument("--size", default="2592x1520", help="picture size in pixels (default %(default)s)")
    command.add_argument("--fps", type=float, default=25, help="frames per second (default %(default)s)")
    text = "random seed; every seed gives another scene (default %(default)s)"
    command.add_argument("--seed", type=int, default=0, help=text)
    text = "standard deviation of the length of each bone between birds, as a share; 0: bones of the model"
    command.add_argument("--bone-sd", type=float, default=0.05, metavar="SHARE", help=f"{text} (default %(default)s)")
    text = "mean distance between the detector's keypoints and those of the model, as a share of the body length"
    command.add_argument(
        "--keypoint-offset", type=float, default=0.02, metavar="SHARE", help=f"{text} (default %(default)s)"
    )
    text = "film the scene with several cameras: their number, or a file of calibrated cameras"
    command.add_argument("--cameras", metavar="N|FILE", help=text)
    text = "with a number of cameras: lenses with distortion, and principal points beside the middle of the picture"
    command.add_argument("--distortion", action="store_true", help=text)
    command.shared("--codec")


@_command("research", "evaluate", "fitting.evaluate")
def _evaluate(command: Parser) -> None:
    """Compare a result, or observations, with annotations or with the ground truth of a simulated scene."""
    command.add_argument("result", type=Path, metavar="DIR|OBS", help=f"folder of a result, or {OBSERVATIONS}")
    add_truth(command)
    add_observation_options(command)
    text = "also print the metrics by behaviour (of a simulated scene) or by keypoint"
    command.add_argument("--by", choices=("behaviour", "keypoint"), help=text)
    text = "print how well the error bars of a result agree with its errors, instead of the metrics"
    command.add_argument("--calibration", action="store_true", help=text)
    text = "with --calibration: also plot the coverage over the probability"
    command.add_argument("--plot", type=Path, metavar="PLOT.png", help=text)
    text = "print JSON instead of tables, with the metrics by behaviour and keypoint"
    command.add_argument("--json", action="store_true", help=text)


@_command("research", "calibrate", "training.calibrate")
def _calibrate(command: Parser) -> None:
    """Estimate the errors of detections from labelled frames, and write a config of a fit that holds them."""
    command.add_argument("detections", type=Path, metavar="OBS", help=OBSERVATIONS)
    text = "labels of some frames of the same video (formats as of OBS), or a scene"
    command.add_argument("--truth", type=Path, required=True, metavar="LABELS", help=text)
    add_observation_options(command)
    add_out(command, "NOISE.yaml", "config to write, for `jaxfit fit --config`", overwrite="an existing file")


@_command("research", "ablate", "experiments.ablate")
def _ablate(command: Parser) -> None:
    """Fit the same birds with a grid of configs and compare the results (needs the extra `report`)."""
    text = "COCO file with the keypoint names of the model; `jaxfit import` writes it from other files"
    command.add_argument("observations", type=Path, metavar="OBS.json", help=text)
    add_truth(command)
    text = "`ablation` (34 runs, after the paper) or a YAML file (default %(default)s)"
    command.add_argument("--grid", default="ablation", help=text)
    command.shared("--model")
    add_cluster(command)
    add_out(command, "DIR", "folder for runs, tables and report; an interrupted ablation continues")
    command.dropped("--allow-import", "name the term in the grid")


@_command("research", "dataset murre", "observations.murre")
def _dataset_murre(command: Parser) -> None:
    """Convert common_murre_temporal, with an inferred layout, to a COCO file."""
    command.add_argument("folder", type=Path, metavar="DIR", help="folder with annotations.npy and images/")
    text = "names of the 20 keypoints in order, with commas; `murre` for the names of the murre model; or `none` for "
    text += "numbers as names (default %(default)s)"
    command.add_argument("--keypoints", default="none", metavar="NAMES", help=text)
    add_out(command, "OBS.json", "COCO file to write", overwrite="an existing file")


def build_parser() -> Parser:
    """Return the parser of the whole command line."""
    parser = Parser(
        prog="jaxfit",
        usage="jaxfit [-h] [--version] [-v] COMMAND ...",
        description="3D pose and shape of birds from video, on a CPU.",
        epilog=_groups(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"jaxfit {own_version()}")
    parser.add_argument("-v", "--verbose", action="store_true", help="print more messages, also of libraries")
    subparsers = parser.add_subparsers(required=True, prog="jaxfit", metavar="COMMAND", help=argparse.SUPPRESS)
    families: dict[str, Any] = {"": subparsers}
    for group in COMMANDS.values():
        for name, command in group.items():
            family, _, action = name.rpartition(" ")
            if family not in families:
                text = _FAMILIES[family]
                own = families[""].add_parser(family, help=text, description=f"{text.capitalize()}.")
                families[family] = own.add_subparsers(required=True, metavar="ACTION")
            added = families[family].add_parser(action, help=_phrase(command.text), description=command.text)
            added.set_defaults(run=command.run)
            added.declare = command.declare
    return parser


def _phrase(sentence: str) -> str:
    return sentence[0].lower() + sentence[1:].rstrip(".")


def _groups() -> str:
    """Return the commands by group, for `jaxfit --help`."""
    lines = []
    for group, commands in COMMANDS.items():
        lines.append(f"{group}:")
        words = {name.split()[0]: command for name, command in commands.items()}
        for word, command in words.items():
            text = _FAMILIES.get(word) or _phrase(command.text)
            lines += textwrap.wrap(text, 78, initial_indent=f"  {word:<13}", subsequent_indent=" " * 15)
    return "\n".join([*lines, "", "`jaxfit COMMAND --help` lists the arguments of a command."])
