"""The command line: what can be asked, and how failures are told.

A parser names the function of `jaxfit.cli` that runs: its module is imported once a command is known.
"""

from __future__ import annotations

import argparse
import logging
import os
import signal
import sys
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import NoReturn

from jaxfit import __version__
from jaxfit.errors import InputError
from jaxfit.video.codecs import CODECS

__all__ = ["main", "run", "use_cache"]

STOPPED = 130


def run() -> NoReturn:
    """The command as installed: `main` on the terminal's arguments, which ends the process."""
    asked: list[int] = []

    def stop(number: int, _frame: object) -> None:
        asked.append(number)
        raise KeyboardInterrupt

    def insist(swallowed: sys.UnraisableHookArgs) -> None:
        """An interrupt that met a callback of the garbage collector is lost there: it comes again."""
        if not asked or not issubclass(swallowed.exc_type, KeyboardInterrupt):
            sys.__unraisablehook__(swallowed)
            return
        signal.signal(signal.SIGALRM, stop)
        signal.setitimer(signal.ITIMER_REAL, 0.05)

    sys.unraisablehook = insist
    for number in (signal.SIGINT, signal.SIGTERM):  # a batch system's kill cleans up as Ctrl-C does
        if signal.getsignal(number) is not signal.SIG_IGN:  # as a shell has it for its background jobs
            signal.signal(number, stop)
    try:
        code = main()
    except Exception:
        if not asked:
            raise
        code = _stopped()  # compiled code made an error of its own of the interrupt
    if code == STOPPED:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError):  # the reader of our output may be gone
                stream.flush()
        # XLA's threads still compute what was interrupted, and crash where the interpreter is taken down below them
        os._exit(code)
    sys.exit(code)


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 2 unusable input, 130 stopped by Ctrl-C."""
    options = _parser().parse_args(arguments)
    logging.basicConfig(format="%(message)s", level=logging.INFO if options.verbose else logging.WARNING)
    try:
        use_cache()
        module, command = options.run.split(".")
        # here, so that help and refusals need not wait for all that commands import
        getattr(import_module(f"jaxfit.cli.{module}"), command)(options)
    except InputError as error:
        print(f"jaxfit: {error}", file=sys.stderr)  # noqa: T201
        return 2
    except KeyboardInterrupt:
        return _stopped()
    except BrokenPipeError:  # the reader of our output went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return 0


def _stopped() -> int:
    print("jaxfit: stopped; nothing half-written is left", file=sys.stderr)  # noqa: T201
    return STOPPED


def use_cache() -> None:
    """Keep compiled programs between runs, in the user's cache folder."""
    import jax

    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jaxfit"
    jax.config.update("jax_compilation_cache_dir", str(cache))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


MODEL = "`murre`, or a model file (.npz) as `jaxfit model import` writes it"
CODEC_NAMES = ("auto", *CODECS)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="jaxfit", description="3D pose and shape of birds from video, on a CPU.")
    parser.add_argument("--version", action="version", version=f"jaxfit {__version__}")
    parser.add_argument("-v", "--verbose", action="store_true", help="say more about what is done")
    add = parser.add_subparsers(required=True, metavar="COMMAND").add_parser
    _perception(add)
    _fitting(add)
    _simulation(add)
    _training(add)
    _datasets(add)
    _models(add)
    bench = add("bench", help="measure speed on this machine")
    bench.add_argument("what", choices=("silhouette", "render", "fit", "solvers"))
    bench.add_argument("--model", help=f"measure with this model instead of the default: {MODEL}")
    bench.add_argument("--birds", type=int, default=9, help="fit, solvers: birds (default 9)")
    bench.add_argument("--frames", type=int, default=100, help="fit, solvers: frames a bird (default 100)")
    bench.add_argument("--observations", type=Path, metavar="OBS.json", help="solvers: fit these, not a simulation")
    bench.add_argument("--plot", type=Path, metavar="PNG", help="solvers: draw loss over time (extra `report`)")
    bench.add_argument("--json", action="store_true")
    bench.set_defaults(run="bench.bench")
    return parser


def _perception(add) -> None:
    track = add("track", help="find and follow the birds of a video, and their keypoints")
    _what_to_track(track)
    track.add_argument("--out", type=Path, required=True, metavar="OBS.json", help="COCO file to write")
    track.add_argument("--overwrite", action="store_true", help="replace an earlier file of that name")
    track.set_defaults(run="perception.track")

    reconstruct = add("reconstruct", help="track the birds of a video, pose and draw them")
    _what_to_track(reconstruct)
    reconstruct.add_argument("--model", default="murre", help=f"{MODEL} (default murre)")
    reconstruct.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the result")
    reconstruct.add_argument("--overwrite", action="store_true", help="replace an earlier result in that folder")
    reconstruct.set_defaults(run="perception.reconstruct")


def _what_to_track(command: argparse.ArgumentParser) -> None:
    command.add_argument("video", type=Path, metavar="VIDEO", help="a video, or a folder of frames")
    command.add_argument(
        "--config", default="reconstruct", help="YAML file with a `base: reconstruct`, which names every knob"
    )
    command.add_argument(
        "--segmenter",
        metavar="S.onnx",
        help="network that finds birds, or detector.onnx+saliency.onnx (default: built in)",
    )
    command.add_argument(
        "--keypoints", metavar="K.onnx", help="network that finds the keypoints of each (default: built in)"
    )
    command.add_argument("--classes", metavar="NAMES", help="classes to look for, by comma (default bird)")
    command.add_argument("--start", type=int, metavar="FRAME", help="first frame, counted from 0")
    command.add_argument("--stop", type=int, metavar="FRAME", help="frame to stop before")
    command.add_argument("--step", type=int, metavar="N", help="look at every N-th frame")


def _fitting(add) -> None:
    fit = add("fit", help="pose the birds of a COCO file of keypoints and masks")
    fit.add_argument("observations", type=Path, metavar="OBS.json")
    fit.add_argument("--model", default="murre", help=f"{MODEL} (default murre)")
    fit.add_argument("--config", default="paper", help="name of a shipped config (paper, baseline, …) or a YAML file")
    fit.add_argument("--init", type=Path, help="starting poses (.npz): a regressor's, or an earlier poses.npz")
    fit.add_argument("--out", type=Path, required=True, help="folder for the result")
    fit.add_argument("--overwrite", action="store_true", help="replace an earlier result in that folder")
    fit.set_defaults(run="fitting.fit")

    evaluate = add("evaluate", help="compare a result, or observations, with annotations or a scene's truth")
    evaluate.add_argument("result", type=Path, metavar="DIR|OBS.json")
    evaluate.add_argument("--truth", type=Path, required=True, help="COCO file of annotations, or a simulated scene")
    evaluate.add_argument(
        "--match",
        choices=("auto", "ids", "overlap"),
        default="auto",
        help="whose track of DIR is whose (default auto: by ids, unless a track follows another bird than its id's)",
    )
    evaluate.add_argument(
        "--by",
        choices=("behaviour", "keypoint"),
        help="a table of these too; behaviours are those of a simulated scene",
    )
    evaluate.add_argument(
        "--json", action="store_true", help="print JSON instead of tables, behaviours and keypoints included"
    )
    evaluate.set_defaults(run="fitting.evaluate")

    ablate = add("ablate", help="fit the same birds under a grid of configs, and compare (needs the extra `report`)")
    ablate.add_argument("observations", type=Path, metavar="OBS.json")
    ablate.add_argument("--truth", type=Path, required=True, help="COCO file of annotations, or a simulated scene")
    ablate.add_argument("--grid", default="ablation", help="`ablation` (the paper's 34 runs) or a YAML file")
    ablate.add_argument("--model", default="murre", help=f"{MODEL} (default murre)")
    ablate.add_argument("--match", choices=("auto", "ids", "overlap"), default="auto", help="as of `evaluate`")
    ablate.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="folder for all of it; one that was interrupted goes on"
    )
    ablate.set_defaults(run="ablation.ablate")

    overlay = add("overlay", help="draw a result on its video")
    overlay.add_argument("result", type=Path, metavar="DIR")
    overlay.add_argument("--video", type=Path, required=True, help="the video (or folder of frames) that was fitted")
    overlay.add_argument("--out", type=Path, required=True, help="video to write; its contact sheet stands beside it")
    overlay.add_argument("--observations", type=Path, metavar="OBS.json", help="draw the detected keypoints too")
    overlay.add_argument("--side-views", action="store_true", help="show every bird from the side as well")
    overlay.add_argument("--frame", type=int, help="draw this frame alone, as a picture (.png or .jpg)")
    overlay.add_argument("--codec", default="auto", choices=CODEC_NAMES)
    overlay.add_argument("--overwrite", action="store_true", help="replace earlier files of these names")
    overlay.set_defaults(run="fitting.overlay")


def _simulation(add) -> None:
    simulate = add("simulate", help="film simulated murres on a ledge, with the truth")
    simulate.add_argument("--out", type=Path, required=True, metavar="SCENE", help="folder for the scene")
    simulate.add_argument("--birds", type=int, default=7, help="how many (default 7)")
    simulate.add_argument("--frames", type=int, default=100, help="how many (default 100)")
    simulate.add_argument("--size", default="2592x1520", help="of the picture, pixels (default 2592x1520)")
    simulate.add_argument("--fps", type=float, default=25, help="frames a second (default 25)")
    simulate.add_argument("--seed", type=int, default=0, help="another seed gives another scene (default 0)")
    simulate.add_argument("--codec", default="auto", choices=CODEC_NAMES)
    simulate.add_argument("--overwrite", action="store_true", help="replace an earlier scene in that folder")
    simulate.set_defaults(run="simulation.simulate")

    demo = add("demo", help="simulate a short scene, reconstruct it from its footage, and show what came of it")
    demo.add_argument("--out", type=Path, default=Path("demo"), help="folder for everything (default demo)")
    demo.set_defaults(run="simulation.demo")


def _training(add) -> None:
    train = add("train", help="train a built-in network anew on simulated footage (needs the extra `train`)")
    train.add_argument("network", choices=("segmenter", "keypoints"))
    train.add_argument("--out", type=Path, required=True, metavar="N.onnx", help="network to write")
    train.add_argument(
        "--frames", type=Path, default=Path("training_frames"), help="folder to film to, or filmed before (5 GB)"
    )
    train.add_argument("--scenes", type=int, default=160, help="to learn from, 10 frames each (default 160)")
    train.add_argument("--steps", type=int, help="of training (default: as the built-in one was trained)")
    train.add_argument("--seed", type=int, default=0, help="of first weights and of samples (default 0)")
    train.add_argument("--overwrite", action="store_true", help="replace an earlier file of that name")
    train.set_defaults(run="training.train")


def _datasets(add) -> None:
    actions = add("dataset", help="read published data sets").add_subparsers(required=True, metavar="NAME")
    murre = actions.add_parser("murre", help="common_murre_temporal, whose layout is inferred, as a COCO file")
    murre.add_argument("folder", type=Path, metavar="DIR", help="folder with annotations.npy and images/")
    murre.add_argument(
        "--keypoints",
        default="none",
        metavar="NAMES",
        help="the 20 in order, by comma; `murre` if you know them to be that model's; default none: they are numbered",
    )
    murre.add_argument("--out", type=Path, required=True, metavar="OBS.json", help="COCO file to write")
    murre.add_argument("--overwrite", action="store_true", help="replace an earlier file of that name")
    murre.set_defaults(run="datasets.murre")


def _models(add) -> None:
    actions = add("model", help="import, inspect and show bird models").add_subparsers(required=True, metavar="ACTION")
    importer = actions.add_parser("import", help="import a published model")
    importer.add_argument("kind", choices=("avian-mesh", "aves"))
    importer.add_argument("sources", type=Path, nargs="+", help="its files, or the folder that holds them")
    importer.add_argument("--out", type=Path, required=True, help="model file to write (.npz)")
    importer.set_defaults(run="models.model_import")
    info = actions.add_parser("info", help="what a model holds")
    info.add_argument("file", metavar="MODEL", help=MODEL)
    info.add_argument("--json", action="store_true")
    info.set_defaults(run="models.model_info")
    view = actions.add_parser("view", help="draw a model from six sides")
    view.add_argument("file", metavar="MODEL", help=MODEL)
    view.add_argument("--out", type=Path, required=True, help="PNG to write")
    view.add_argument(
        "--posture", help="of the murre: standing, incubating, … (default: standing; other models at rest)"
    )
    view.set_defaults(run="models.model_view")

    priors = add("prior", help="learn a pose prior from results").add_subparsers(required=True, metavar="ACTION")
    learn = priors.add_parser("learn", help="write a model whose pose prior is learnt from the poses of results")
    learn.add_argument("results", type=Path, nargs="+", metavar="RESULTS", help="folders that fits of one model wrote")
    learn.add_argument("--out", type=Path, required=True, metavar="P.npz", help="model file to write, for `--model`")
    learn.set_defaults(run="models.prior_learn")
