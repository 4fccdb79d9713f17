"""The arguments of every command.

A command names its function as `module.function` of `jaxfit.cli`. The module is imported when the command runs, so that
`--help` and wrong arguments need no other library.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from jaxfit import __version__
from jaxfit.cli.adapt_parser import add_adapt_commands, add_model_commands
from jaxfit.config.help import option_help
from jaxfit.config.perception import TrackConfig
from jaxfit.errors import InputError
from jaxfit.video.codecs import CODECS

__all__ = ["build_parser"]

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
}
"""Option of the commands that track → the path of its setting in `TrackConfig`, which holds its description."""


class _Parser(argparse.ArgumentParser):
    """A parser that reports wrong arguments in one line, and exits with code 2."""

    def error(self, message: str) -> NoReturn:
        command = self.prog.partition(" ")[2] or "arguments"
        self.exit(2, f"jaxfit: {InputError(command, message, f'see `{self.prog} --help`')}\n")


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    parser = _Parser(prog="jaxfit", description="3D pose and shape of birds from video, on a CPU.")
    parser.add_argument("--version", action="version", version=f"jaxfit {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="print more messages, also of libraries")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    groups = (_perception, _labelling, _import, _fitting, _simulation, _training, _datasets, _models, _configs, _bench)
    for add_commands in (*groups, add_adapt_commands):
        add_commands(commands)
    return parser


def _command(commands: Any, name: str, run: str, text: str) -> argparse.ArgumentParser:
    """Add a command that calls the function `run` (`module.function` of `jaxfit.cli`)."""
    command = commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
    command.set_defaults(run=run)
    return command


def _add_model(command: argparse.ArgumentParser) -> None:
    command.add_argument("--model", default="murre", help=f"{MODEL} (default %(default)s)")


def _add_truth(command: argparse.ArgumentParser) -> None:
    command.add_argument("--truth", type=Path, required=True, help="annotations (formats as of OBS), or a scene")
    text = "match tracks with annotated birds by track id (ids) or by overlap; auto matches by overlap only if a track "
    text += "follows another bird than its id says (default %(default)s)"
    command.add_argument("--match", choices=("auto", "ids", "overlap"), default="auto", help=text)


def _add_out(command: argparse.ArgumentParser, metavar: str, text: str, overwrite: str = "") -> None:
    """Add `--out`, and `--overwrite` if the command can replace what is there."""
    command.add_argument("--out", type=Path, required=True, metavar=metavar, help=text)
    if overwrite:
        command.add_argument("--overwrite", action="store_true", help=f"replace {overwrite}")


def _add_observation_options(command: argparse.ArgumentParser, video: bool = True) -> None:
    """Add the options that files of other tracking programs may need."""
    text = "YAML file with lines `name in the file: name in the model` (default: names are mapped by their words)"
    command.add_argument("--names", type=Path, metavar="MAP.yaml", help=text)
    if video:
        text = "video (or folder of pictures) of the keypoints, for files that do not store the size of the images"
        command.add_argument("--video", type=Path, help=text)
        command.add_argument("--size", metavar="WxH", help="size of the images in pixels, in place of --video")
    else:
        command.set_defaults(size=None)


def _add_codec(command: argparse.ArgumentParser) -> None:
    text = "codec of the video (default auto: the first that is installed)"
    command.add_argument("--codec", default="auto", choices=("auto", *CODECS), help=text)


def _add_tracking_options(command: argparse.ArgumentParser) -> None:
    """Add the video and the settings of tracking."""
    command.add_argument("video", type=Path, metavar="VIDEO", help="a video, or a folder of frames")
    text = "YAML file with `base: reconstruct` and changed settings; `jaxfit config show reconstruct` lists them all"
    command.add_argument("--config", default="reconstruct", help=text)
    for option, (path, details) in TRACK_OPTIONS.items():
        text = option_help(TrackConfig, path)
        command.add_argument(option, dest=f"track.{path}", help=text[0].lower() + text[1:], **details)


def _labelling(commands: Any) -> None:
    text = "choose frames that a person should label, and write their pictures and pre-filled labels (extra `formats`)"
    suggest = _command(commands, "suggest", "labelling.suggest_frames", text)
    _add_tracking_options(suggest)
    text = "result of this video, instead of tracking: a folder of reconstruct or fit, or a file of keypoints (as OBS)"
    suggest.add_argument("--result", type=Path, metavar="DIR|OBS", help=text)
    suggest.add_argument("--count", type=int, default=40, help="number of frames (default %(default)s)")
    suggest.add_argument("--empty", action="store_true", help="write no labels, for footage with low trust")
    _add_out(suggest, "DIR", "folder for the pictures and labels", overwrite="earlier suggestions in the folder")


def _perception(commands: Any) -> None:
    track = _command(commands, "track", "perception.track", "detect and track the birds of a video and their keypoints")
    text = "track the birds of a video, fit their poses and draw them"
    reconstruct = _command(commands, "reconstruct", "perception.reconstruct", text)
    for command in (track, reconstruct):
        _add_tracking_options(command)
    _add_out(track, "OBS.json", "COCO file to write", overwrite="an existing file")
    _add_model(reconstruct)
    _add_out(reconstruct, "DIR", "folder for the result", overwrite="an earlier result in the folder")


def _fitting(commands: Any) -> None:
    fit = _command(commands, "fit", "fitting.fit", "fit the poses of birds to keypoints and masks")
    fit.add_argument("observations", type=Path, metavar="OBS", help=OBSERVATIONS)
    _add_observation_options(fit)
    _add_model(fit)
    text = "name of a shipped config (paper, baseline, …) or a YAML file (default %(default)s)"
    fit.add_argument("--config", default="paper", help=text)
    text = "initial poses: the output of a pose regressor, or an earlier poses.npz"
    fit.add_argument("--init", type=Path, metavar="POSES.npz", help=text)
    _add_out(fit, "DIR", "folder for the result", overwrite="an earlier result in the folder")

    text = "compare a result, or observations, with annotations or with the ground truth of a simulated scene"
    evaluate = _command(commands, "evaluate", "fitting.evaluate", text)
    evaluate.add_argument("result", type=Path, metavar="DIR|OBS", help=f"folder of a result, or {OBSERVATIONS}")
    _add_truth(evaluate)
    _add_observation_options(evaluate)
    text = "also print the metrics by behaviour (of a simulated scene) or by keypoint"
    evaluate.add_argument("--by", choices=("behaviour", "keypoint"), help=text)
    text = "print JSON instead of tables, with the metrics by behaviour and keypoint"
    evaluate.add_argument("--json", action="store_true", help=text)

    text = "fit the same birds with a grid of configs and compare the results (needs the extra `report`)"
    ablate = _command(commands, "ablate", "ablation.ablate", text)
    text = "COCO file with the keypoint names of the model; `jaxfit import` writes it from other files"
    ablate.add_argument("observations", type=Path, metavar="OBS.json", help=text)
    _add_truth(ablate)
    text = "`ablation` (34 runs, after the paper) or a YAML file (default %(default)s)"
    ablate.add_argument("--grid", default="ablation", help=text)
    _add_model(ablate)
    _add_out(ablate, "DIR", "folder for runs, tables and report; an interrupted ablation continues")
    text = "accept a record in DIR that names this term (package.module:function), although the grid does not"
    ablate.add_argument("--allow-import", action="append", default=[], metavar="NAME", help=text)

    overlay = _command(commands, "overlay", "fitting.overlay", "draw a result on its video")
    overlay.add_argument("result", type=Path, metavar="DIR", help="folder of a result")
    overlay.add_argument("--video", type=Path, required=True, help="the video (or folder of frames) of the result")
    _add_out(
        overlay, "FILE", "video to write; the same folder receives a contact sheet (.png)", overwrite="existing files"
    )
    overlay.add_argument("--observations", type=Path, metavar="OBS", help="also draw the detected keypoints")
    _add_observation_options(overlay, video=False)
    overlay.add_argument("--side-views", action="store_true", help="also show every bird from its side")
    overlay.add_argument("--frame", type=int, help="draw only this frame, as a picture (.png or .jpg)")
    _add_codec(overlay)


def _simulation(commands: Any) -> None:
    text = "film simulated murres on a ledge and store the ground truth"
    simulate = _command(commands, "simulate", "simulation.simulate", text)
    _add_out(simulate, "SCENE", "folder for the scene", overwrite="an earlier scene in the folder")
    simulate.add_argument("--birds", type=int, default=7, help="number of birds (default %(default)s)")
    simulate.add_argument("--frames", type=int, default=100, help="number of frames (default %(default)s)")
    simulate.add_argument("--size", default="2592x1520", help="picture size in pixels (default %(default)s)")
    simulate.add_argument("--fps", type=float, default=25, help="frames per second (default %(default)s)")
    text = "random seed; every seed gives another scene (default %(default)s)"
    simulate.add_argument("--seed", type=int, default=0, help=text)
    _add_codec(simulate)

    text = "simulate a short scene, reconstruct the scene from its footage, and measure the result"
    demo = _command(commands, "demo", "simulation.demo", text)
    text = "folder for all files (default %(default)s)"
    demo.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help=text)


def _training(commands: Any) -> None:
    text = "train a network on labelled footage, or a built-in network again (needs the extra `train`)"
    train = _command(commands, "train", "training.train", text)
    train.add_argument("network", choices=("segmenter", "keypoints"), help="network to train")
    _add_out(train, "N.onnx", "network file to write", overwrite="an existing file")
    text = f"labelled frames: {OBSERVATIONS}; for a segmenter also COCO masks without keypoints, or folders of masks"
    train.add_argument("--labels", type=Path, nargs="+", metavar="FILE", help=text)
    text = "video or folder of the labelled frames, one for all files or one for each (default: beside the labels)"
    train.add_argument("--images", type=Path, nargs="+", metavar="DIR|VIDEO", help=text)
    text = "masks of the labelled birds: a folder of pictures, or a COCO file"
    train.add_argument("--masks", type=Path, metavar="DIR|OBS.json", help=text)
    text = "network to start from: `builtin`, or a network that this command wrote (default %(default)s)"
    train.add_argument("--base", default="builtin", metavar="N.onnx", help=text)
    text = "share of the labelled frames for the check of the result; 0 trains without a check (default %(default)s)"
    train.add_argument("--holdout", type=float, default=0.2, metavar="SHARE", help=text)
    text = "folder of simulated frames; absent frames are simulated first (default: simulated_frames with labels, else "
    text += "training_frames, 5 GB)"
    train.add_argument("--frames", type=Path, metavar="DIR", help=text)
    text = "number of simulated scenes, of 10 frames each (default: 20 with labels, else 160)"
    train.add_argument("--scenes", type=int, help=text)
    text = "without labels: share of scenes with other birds in other landscapes (default %(default)s)"
    train.add_argument("--varied", type=float, default=0.0, metavar="SHARE", help=text)
    train.add_argument("--steps", type=int, help="number of training steps (default: by the number of labels)")
    train.add_argument("--seed", type=int, default=0, help="seed of new weights and of samples (default %(default)s)")


def _datasets(commands: Any) -> None:
    dataset = commands.add_parser("dataset", help="convert published data sets")
    actions = dataset.add_subparsers(required=True, metavar="NAME")
    text = "convert common_murre_temporal, with an inferred layout, to a COCO file"
    murre = _command(actions, "murre", "datasets.murre", text)
    murre.add_argument("folder", type=Path, metavar="DIR", help="folder with annotations.npy and images/")
    text = "names of the 20 keypoints in order, with commas; `murre` for the names of the murre model; or `none` for "
    text += "numbers as names (default %(default)s)"
    murre.add_argument("--keypoints", default="none", metavar="NAMES", help=text)
    _add_out(murre, "OBS.json", "COCO file to write", overwrite="an existing file")


def _import(commands: Any) -> None:
    text = "convert keypoints of DeepLabCut, SLEAP, Lightning Pose, CVAT or Label Studio to a COCO file"
    importer = _command(commands, "import", "importing.import_observations", text)
    importer.add_argument("file", type=Path, metavar="FILE", help=OBSERVATIONS)
    _add_out(importer, "OBS.json", "COCO file to write", overwrite="an existing file")
    _add_observation_options(importer)
    text = "masks of the birds: a folder of pictures, one for every frame, or a COCO file"
    importer.add_argument("--masks", type=Path, metavar="DIR|OBS.json", help=text)
    _add_model(importer)


def _models(commands: Any) -> None:
    model = commands.add_parser("model", help="import, describe and draw bird models")
    actions = model.add_subparsers(required=True, metavar="ACTION")
    importer = _command(actions, "import", "models.model_import", "import a published model")
    importer.add_argument("kind", choices=("avian-mesh", "aves"), help="kind of model")
    importer.add_argument("sources", type=Path, nargs="+", help="files of the model, or the folder that holds them")
    _add_out(importer, "M.npz", "model file to write")
    info = _command(actions, "info", "models.model_info", "describe a model")
    info.add_argument("file", metavar="MODEL", help=MODEL)
    info.add_argument("--json", action="store_true", help="print JSON instead of a table")
    view = _command(actions, "view", "models.model_view", "draw a model from six sides")
    view.add_argument("file", metavar="MODEL", help=MODEL)
    _add_out(view, "PNG", "picture to write")
    text = "posture of the murre: standing, incubating, … (default standing; other models have only the rest pose)"
    view.add_argument("--posture", help=text)
    add_model_commands(actions)

    prior = commands.add_parser("prior", help="learn a pose prior from results")
    actions = prior.add_subparsers(required=True, metavar="ACTION")
    text = "learn a pose prior from the poses of results and write a model with this prior"
    learn = _command(actions, "learn", "models.prior_learn", text)
    learn.add_argument("results", type=Path, nargs="+", metavar="RESULTS", help="result folders of fits of one model")
    _add_out(learn, "P.npz", "model file to write, for `--model`")


def _configs(commands: Any) -> None:
    config = commands.add_parser("config", help="print the settings of configs")
    actions = config.add_subparsers(required=True, metavar="ACTION")
    show = _command(actions, "show", "configs.show_config", "print all settings of a config with their descriptions")
    show.add_argument("name", metavar="NAME", help="name of a shipped config: reconstruct, paper, ablation, …")


def _bench(commands: Any) -> None:
    bench = _command(commands, "bench", "bench.bench", "measure speed on this machine")
    bench.add_argument("what", choices=("silhouette", "render", "fit", "solvers"), help="part to measure")
    bench.add_argument("--model", help=f"model to measure with, instead of the default: {MODEL}")
    bench.add_argument("--birds", type=int, default=9, help="fit, solvers: number of birds (default %(default)s)")
    bench.add_argument("--frames", type=int, default=100, help="fit, solvers: frames per bird (default %(default)s)")
    text = "solvers: fit this COCO file instead of a simulation"
    bench.add_argument("--observations", type=Path, metavar="OBS.json", help=text)
    bench.add_argument("--plot", type=Path, metavar="PNG", help="solvers: plot the loss over time (extra `report`)")
    bench.add_argument("--json", action="store_true", help="print JSON instead of a table")
