"""The arguments of every command.

A command names its function as `module.function` of `jaxfit.cli`. The module is imported when the command runs, so that
`--help` and wrong arguments need no other library.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from jaxfit.cli.arguments import (
    CAMERAS,
    MODEL,
    OBSERVATIONS,
    PLANE,
    Parser,
    add_adapt_commands,
    add_cluster,
    add_codec,
    add_command,
    add_focal,
    add_force,
    add_model,
    add_model_commands,
    add_observation_options,
    add_out,
    add_result_commands,
    add_tracking_options,
    add_truth,
    add_unit,
    add_view_options,
)
from jaxfit.foundation.extras import own_version


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    parser = Parser(prog="jaxfit", description="3D pose and shape of birds from video, on a CPU.")
    parser.add_argument("--version", action="version", version=f"jaxfit {own_version()}")
    parser.add_argument("-v", "--verbose", action="store_true", help="print more messages, also of libraries")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    for add_commands in (
        _perception,
        _labelling,
        _import,
        _fitting,
        _comparing,
        add_result_commands,
        _cameras,
        _simulation,
        _training,
        _datasets,
        _models,
        _configs,
        _bench,
        add_adapt_commands,
    ):
        add_commands(commands)
    return parser


def _labelling(commands: Any) -> None:
    text = "choose frames that a person should label, and write their pictures and pre-filled labels (extra `formats`)"
    suggest = add_command(commands, "suggest", "perception.suggest_frames", text)
    add_tracking_options(suggest)
    text = "result of this video, instead of tracking: a folder of reconstruct or fit, or a file of keypoints (as OBS)"
    suggest.add_argument("--result", type=Path, metavar="DIR|OBS", help=text)
    suggest.add_argument("--count", type=int, default=40, help="number of frames (default %(default)s)")
    text = "second segmenter, such as `general`: suggest the frames in which its masks differ most from the others"
    suggest.add_argument("--teacher", metavar="NAME", help=text)
    suggest.add_argument("--empty", action="store_true", help="write no labels, for footage with low trust")
    add_out(suggest, "DIR", "folder for the pictures and labels", overwrite="earlier suggestions in the folder")


def _perception(commands: Any) -> None:
    text = "detect and track the birds of a video and their keypoints"
    track = add_command(commands, "track", "perception.track", text)
    text = "track the birds of a video, fit their poses and draw them"
    reconstruct = add_command(commands, "reconstruct", "perception.reconstruct", text)
    for command in (track, reconstruct):
        add_tracking_options(command)
    add_out(track, "OBS.json", "COCO file to write", overwrite="an existing file")
    add_model(reconstruct)
    add_cluster(track, "run the networks")
    add_cluster(reconstruct, "run the networks and fit windows")
    add_out(reconstruct, "DIR", "folder for the result", overwrite="an earlier result in the folder")


def _fitting(commands: Any) -> None:
    fit = add_command(commands, "fit", "fitting.fit", "fit the poses of birds to keypoints and masks")
    text = f"{OBSERVATIONS}; with --cameras one file for each camera"
    fit.add_argument("observations", type=Path, nargs="+", metavar="OBS", help=text)
    add_observation_options(fit)
    fit.add_argument("--cameras", type=Path, metavar="FILE", help=f"fit all views at once, in the world; {CAMERAS}")
    add_view_options(fit)
    text = f"place the birds on the ledge that they stand on, in a world in metres; PLANE is {PLANE} (default birds)"
    fit.add_argument("--ledge", nargs="?", const="birds", metavar="PLANE", help=text)
    add_focal(fit)
    add_model(fit)
    text = "name of a shipped config (paper, baseline, …) or a YAML file (default %(default)s)"
    fit.add_argument("--config", default="paper", help=text)
    text = "initial poses: the output of a pose regressor, or an earlier poses.npz"
    fit.add_argument("--init", type=Path, metavar="POSES.npz", help=text)
    add_cluster(fit)
    add_out(fit, "DIR", "folder for the result", overwrite="an earlier result in the folder")

    text = "compare a result, or observations, with annotations or with the ground truth of a simulated scene"
    evaluate = add_command(commands, "evaluate", "fitting.evaluate", text)
    evaluate.add_argument("result", type=Path, metavar="DIR|OBS", help=f"folder of a result, or {OBSERVATIONS}")
    add_truth(evaluate)
    add_observation_options(evaluate)
    text = "also print the metrics by behaviour (of a simulated scene) or by keypoint"
    evaluate.add_argument("--by", choices=("behaviour", "keypoint"), help=text)
    text = "print how well the error bars of a result agree with its errors, instead of the metrics"
    evaluate.add_argument("--calibration", action="store_true", help=text)
    text = "with --calibration: also plot the coverage over the probability"
    evaluate.add_argument("--plot", type=Path, metavar="PLOT.png", help=text)
    text = "print JSON instead of tables, with the metrics by behaviour and keypoint"
    evaluate.add_argument("--json", action="store_true", help=text)

    text = "estimate the errors of detections from labelled frames, and write a config of a fit that holds them"
    calibrate = add_command(commands, "calibrate", "training.calibrate", text)
    calibrate.add_argument("detections", type=Path, metavar="OBS", help=OBSERVATIONS)
    text = "labels of some frames of the same video (formats as of OBS), or a scene"
    calibrate.add_argument("--truth", type=Path, required=True, metavar="LABELS", help=text)
    add_observation_options(calibrate)
    add_out(calibrate, "NOISE.yaml", "config to write, for `jaxfit fit --config`", overwrite="an existing file")


def _comparing(commands: Any) -> None:
    text = "fit the same birds with a grid of configs and compare the results (needs the extra `report`)"
    ablate = add_command(commands, "ablate", "experiments.ablate", text)
    text = "COCO file with the keypoint names of the model; `jaxfit import` writes it from other files"
    ablate.add_argument("observations", type=Path, metavar="OBS.json", help=text)
    add_truth(ablate)
    text = "`ablation` (34 runs, after the paper) or a YAML file (default %(default)s)"
    ablate.add_argument("--grid", default="ablation", help=text)
    add_model(ablate)
    add_cluster(ablate)
    add_out(ablate, "DIR", "folder for runs, tables and report; an interrupted ablation continues")
    text = "accept a record in DIR that names this term (package.module:function), although the grid does not"
    ablate.add_argument("--allow-import", action="append", default=[], metavar="NAME", help=text)

    overlay = add_command(commands, "overlay", "fitting.overlay", "draw a result on its video")
    overlay.add_argument("result", type=Path, metavar="DIR", help="folder of a result")
    overlay.add_argument("--video", type=Path, required=True, help="the video (or folder of frames) of the result")
    text = "for a result in a world: the camera of the video, by its name in cameras.toml (default: the first camera)"
    overlay.add_argument("--camera", metavar="NAME", help=text)
    add_out(
        overlay, "FILE", "video to write; the same folder receives a contact sheet (.png)", overwrite="existing files"
    )
    overlay.add_argument("--observations", type=Path, metavar="OBS", help="also draw the detected keypoints")
    add_observation_options(overlay, video=False)
    overlay.add_argument("--side-views", action="store_true", help="also show every bird from its side")
    overlay.add_argument("--frame", type=int, help="draw only this frame, as a picture (.png or .jpg)")
    add_force(overlay)
    add_codec(overlay)


def _cameras(commands: Any) -> None:
    cameras = commands.add_parser("cameras", help="calibrate, describe and check cameras")
    actions = cameras.add_subparsers(required=True, metavar="ACTION")
    text = "print the lens and the position of every camera, and draw their fields of view"
    show = add_command(actions, "show", "cameras.show_cameras", text)
    show.add_argument("cameras", type=Path, metavar="FILE", help=CAMERAS)
    add_unit(show)
    show.add_argument(
        "--out", type=Path, metavar="PNG", help="picture to write: the cameras from above and from the side"
    )
    show.add_argument("--overwrite", action="store_true", help="replace an existing file")
    text = "check cameras against the keypoints of birds: errors, wrong order, offset in time, moved camera"
    check = add_command(actions, "check", "cameras.check_calibration", text)
    check.add_argument("cameras", type=Path, metavar="FILE", help=CAMERAS)
    text = f"one file for each camera, in the order of the cameras: {OBSERVATIONS}"
    check.add_argument("observations", type=Path, nargs="+", metavar="OBS", help=text)
    add_observation_options(check)
    add_view_options(check)
    add_model(check)
    text = "calibrate cameras from films of a checkerboard that started together, and write them as anipose TOML"
    calibrate = add_command(actions, "calibrate", "calibrate.calibrate_films", text)
    text = "one video or folder of pictures for each camera; its name is the name of the camera"
    calibrate.add_argument("films", type=Path, nargs="+", metavar="FILM", help=text)
    text = "inner corners of the board, which are one less than the squares in each direction, such as 9x6"
    calibrate.add_argument("--board", required=True, metavar="COLSxROWS", help=text)
    calibrate.add_argument("--square-mm", type=float, required=True, metavar="MM", help="side of a square of the board")
    calibrate.add_argument("--fisheye", action="store_true", help="the lenses are fisheye lenses")
    add_out(calibrate, "CAMERAS.toml", "file to write", overwrite="an existing file")


def _simulation(commands: Any) -> None:
    text = "film simulated murres on a ledge and store the ground truth"
    simulate = add_command(commands, "simulate", "demo.simulate_scene", text)
    add_out(simulate, "SCENE", "folder for the scene", overwrite="an earlier scene in the folder")
    simulate.add_argument("--birds", type=int, default=7, help="number of birds (default %(default)s)")
    simulate.add_argument("--frames", type=int, default=100, help="number of frames (default %(default)s)")
    simulate.add_argument("--size", default="2592x1520", help="picture size in pixels (default %(default)s)")
    simulate.add_argument("--fps", type=float, default=25, help="frames per second (default %(default)s)")
    text = "random seed; every seed gives another scene (default %(default)s)"
    simulate.add_argument("--seed", type=int, default=0, help=text)
    text = "film the scene with several cameras: their number, or a file of calibrated cameras"
    simulate.add_argument("--cameras", metavar="N|FILE", help=text)
    text = "with a number of cameras: lenses with distortion, and principal points beside the middle of the picture"
    simulate.add_argument("--distortion", action="store_true", help=text)
    add_codec(simulate)

    text = "simulate a short scene, reconstruct the scene from its footage, and measure the result"
    demo = add_command(commands, "demo", "demo.demo", text)
    text = "folder for all files (default %(default)s)"
    demo.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR", help=text)
    text = "also print all tables, which are in the report too, and messages of libraries"
    # without a default, so that `jaxfit --verbose demo` stays verbose
    demo.add_argument("-v", "--verbose", action="store_true", default=argparse.SUPPRESS, help=text)


def _training(commands: Any) -> None:
    text = "train a network on labelled footage, or a built-in network again (needs the extra `train`)"
    train = add_command(commands, "train", "training.train", text)
    train.add_argument("network", choices=("segmenter", "keypoints"), help="network to train")
    add_out(train, "N.onnx", "network file to write", overwrite="an existing file")
    text = f"labelled frames: {OBSERVATIONS}; for a segmenter also COCO masks without keypoints, or folders of masks"
    train.add_argument("--labels", type=Path, nargs="+", metavar="FILE", help=text)
    text = "video or folder of the labelled frames, one for all files or one for each (default: beside the labels)"
    train.add_argument("--images", type=Path, nargs="+", metavar="DIR|VIDEO", help=text)
    text = "masks of the labelled birds: a folder of pictures, or a COCO file"
    train.add_argument("--masks", type=Path, metavar="DIR|OBS.json", help=text)
    text = "segmenter without labels: film in which the teacher makes the labels"
    train.add_argument("--video", type=Path, metavar="VIDEO|DIR", help=text)
    text = "segmenter that makes the labels of --video, or tracks the masks of --labels to other frames of their film: "
    text += "`general`, A.onnx+B.onnx, `none`, or `auto`: `general` if its files exist (default %(default)s)"
    train.add_argument("--teacher", default="auto", metavar="NAME", help=text)
    text = "network to start from: `builtin`, or a network that this command wrote (default: builtin with labels, else "
    text += "random weights)"
    train.add_argument("--base", metavar="N.onnx", help=text)
    text = "share of the labelled frames for the check of the result; 0 trains without a check (default %(default)s)"
    train.add_argument("--holdout", type=float, default=0.2, metavar="SHARE", help=text)
    text = "folder of simulated scenes; absent scenes are filmed before the training "
    text += "(default: simulated_frames with labels, else training_frames, 5 GB)"
    train.add_argument("--frames", type=Path, metavar="DIR", help=text)
    train.add_argument(
        "--scenes", type=int, help="simulated scenes, of 10 frames each (default: 20 with labels, else 160)"
    )
    text = "without labels: share of scenes with other birds in other landscapes (default %(default)s)"
    train.add_argument("--varied", type=float, default=0.0, metavar="SHARE", help=text)
    text = "without labels: share of scenes in which the birds flap or fly (default %(default)s)"
    train.add_argument("--wings", type=float, default=0.0, metavar="SHARE", help=text)
    train.add_argument("--encoder", help=argparse.SUPPRESS)  # an option of earlier versions: `train` names the new way
    train.add_argument("--steps", type=int, help="number of training steps (default: by the number of labels)")
    train.add_argument("--seed", type=int, default=0, help="seed of new weights and of samples (default %(default)s)")


def _datasets(commands: Any) -> None:
    dataset = commands.add_parser("dataset", help="convert published data sets")
    actions = dataset.add_subparsers(required=True, metavar="NAME")
    text = "convert common_murre_temporal, with an inferred layout, to a COCO file"
    murre = add_command(actions, "murre", "observations.murre", text)
    murre.add_argument("folder", type=Path, metavar="DIR", help="folder with annotations.npy and images/")
    text = "names of the 20 keypoints in order, with commas; `murre` for the names of the murre model; or `none` for "
    text += "numbers as names (default %(default)s)"
    murre.add_argument("--keypoints", default="none", metavar="NAMES", help=text)
    add_out(murre, "OBS.json", "COCO file to write", overwrite="an existing file")


def _import(commands: Any) -> None:
    text = "convert keypoints of DeepLabCut, SLEAP, Lightning Pose, CVAT or Label Studio to a COCO file"
    importer = add_command(commands, "import", "observations.import_observations", text)
    importer.add_argument("file", type=Path, metavar="FILE", help=OBSERVATIONS)
    add_out(importer, "OBS.json", "COCO file to write", overwrite="an existing file")
    add_observation_options(importer)
    text = "masks of the birds: a folder of pictures, one for every frame, or a COCO file"
    importer.add_argument("--masks", type=Path, metavar="DIR|OBS.json", help=text)
    add_model(importer)


def _models(commands: Any) -> None:
    model = commands.add_parser("model", help="import, describe and draw bird models")
    actions = model.add_subparsers(required=True, metavar="ACTION")
    importer = add_command(actions, "import", "models.model_import", "import a published model")
    importer.add_argument("kind", choices=("avian-mesh", "aves"), help="kind of model")
    importer.add_argument("sources", type=Path, nargs="+", help="files of the model, or the folder that holds them")
    add_out(importer, "M.npz", "model file to write")
    info = add_command(actions, "info", "models.model_info", "describe a model")
    info.add_argument("file", metavar="MODEL", help=MODEL)
    info.add_argument("--json", action="store_true", help="print JSON instead of a table")
    view = add_command(actions, "view", "models.model_view", "draw a model from six sides")
    view.add_argument("file", metavar="MODEL", help=MODEL)
    add_out(view, "PNG", "picture to write")
    text = "posture of the murre: standing, incubating, … (default standing; other models have only the rest pose)"
    view.add_argument("--posture", help=text)
    add_model_commands(actions)

    prior = commands.add_parser("prior", help="learn a prior of poses or of motion from results")
    actions = prior.add_subparsers(required=True, metavar="ACTION")
    text = "learn a pose prior from the poses of results and write a model with this prior, or learn a term of motion"
    learn = add_command(actions, "learn", "models.prior_learn", text)
    learn.add_argument("results", type=Path, nargs="+", metavar="RESULTS", help="result folders of fits of one model")
    text = "learn the term `motion_likelihood` from the angular accelerations of results, and write a config"
    learn.add_argument("--motion", action="store_true", help=text)
    add_out(learn, "P.npz|M.yaml", "model file to write, for `--model`; with --motion: config to write, for `--config`")


def _configs(commands: Any) -> None:
    config = commands.add_parser("config", help="list the configs and print their settings")
    actions = config.add_subparsers(required=True, metavar="ACTION")
    text = "list the configs of fits: what each config is for, and the data on which its values were chosen"
    add_command(actions, "list", "models.list_configs", text)
    show = add_command(actions, "show", "models.show_config", "print all settings of a config with their descriptions")
    show.add_argument("name", metavar="NAME", help="shipped config (reconstruct, paper, …) or file of behaviour rules")


def _bench(commands: Any) -> None:
    bench = add_command(commands, "bench", "experiments.bench", "measure speed on this machine")
    bench.add_argument("what", choices=("silhouette", "outline", "render", "fit", "solvers"), help="part to measure")
    bench.add_argument("--model", help=f"model to measure with, instead of the default: {MODEL}")
    bench.add_argument("--birds", type=int, default=9, help="fit, solvers: number of birds (default %(default)s)")
    bench.add_argument("--frames", type=int, default=100, help="fit, solvers: frames per bird (default %(default)s)")
    bench.add_argument("--config", default="paper", help="fit: config to measure (default %(default)s)")
    text = "solvers: stage of the paper's config to minimise (default %(default)s)"
    bench.add_argument("--stage", choices=("keypoints", "mask"), default="keypoints", help=text)
    text = "solvers: fit this COCO file instead of a simulation"
    bench.add_argument("--observations", type=Path, metavar="OBS.json", help=text)
    bench.add_argument("--plot", type=Path, metavar="PNG", help="solvers: plot the loss over time (extra `report`)")
    bench.add_argument("--json", action="store_true", help="print JSON instead of a table")
