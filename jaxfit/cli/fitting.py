"""Commands that fit poses, evaluate results and draw results."""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxfit.cli.ledge import WORLD, check_ledge_options, place_if_wanted, show_ledge, show_world
from jaxfit.cli.observations import image_size, keypoint_map, observations_for
from jaxfit.cli.tables import (
    FIT_COLUMNS,
    breakdown_tables,
    calibration_tables,
    evaluation_tables,
    fit_cells,
    flag_line,
    flag_quality_line,
    right_aligned,
    show,
    wrong_poses_line,
)
from jaxfit.data.observations import MIN_KEYPOINTS
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.progress import terminal
from jaxfit.foundation.reading import json_text
from jaxfit.model.files import find_bird

if TYPE_CHECKING:
    from jaxfit.config.fit import FitConfig
    from jaxfit.data.keypoint_names import NameMap
    from jaxfit.data.solution import Solution
    from jaxfit.data.views import Views
    from jaxfit.evaluation.truth import Truth
    from jaxfit.fitting.bodies import Body
    from jaxfit.model.bird import Bird


def fit(options: argparse.Namespace) -> None:
    """Fit the poses of birds to observations and write a result."""
    from jaxfit.config.fit import load_config
    from jaxfit.data.result_folder import POSES
    from jaxfit.fitting.fit import fit, learn_weights
    from jaxfit.fitting.initial_poses import load_initial_poses
    from jaxfit.foundation.files import check_replaceable
    from jaxfit.foundation.workers import open_cluster

    start = time.perf_counter()
    check_replaceable(options.out, options.overwrite, POSES)  # before the long work
    config, bird = load_config(options.config), find_bird(options.model)
    check_ledge_options(options, bird)
    if options.ledge is not None:
        from jaxfit.fitting.ledge import ledge_config

        config = ledge_config(config)
    if options.cameras is not None:
        _fit_views(options, config, bird, start)
        return
    _check_one_camera(options)
    (options.observations,) = options.observations
    observations, names = observations_for(options.observations, bird.keypoint_names, options, untracked="photographs")
    if observations.photographs and options.ledge is not None:
        raise InputError(options.observations, "holds photographs, which show no common ledge", "leave out --ledge")
    config = _fewer_keypoints(config, names, options)
    if not config.min_keypoints:
        from jaxfit.perception.keypoints import with_outline_keypoints

        observations = with_outline_keypoints(observations)
    initial_poses = load_initial_poses(options.init, observations, bird) if options.init else None
    bodies = _known_bodies(options, config, bird, observations.track_id.tolist())
    read_s = time.perf_counter() - start
    with open_cluster(options.workers, options.scheduler) as cluster:
        source, learnt = options.observations, None
        if config.learns_first:
            learnt = learn_weights(observations, bird, config, initial_poses, terminal, source)
            config = learnt.config
        solution = fit(
            observations, bird, config, initial_poses, terminal, source=source, cluster=cluster, bodies=bodies
        )
    seconds = {"read": read_s, "fit": time.perf_counter() - start - read_s}
    subject, facts = counted(len(solution.track_id), "track"), {}
    if observations.photographs:  # every bird has a photograph of its own
        facts["photographs"] = observations.photographs
        photographs = counted(observations.photographs, "photograph")
        subject = f"{counted(len(solution.track_id), 'bird')} in {photographs}"
    _write_fit(options, config, bird, solution, None, seconds, facts, subject, learnt and learnt.to_yaml())


def _known_bodies(
    options: argparse.Namespace, config: FitConfig, bird: Bird, tracks: list[int]
) -> dict[int, Body] | None:
    """Return the bodies of the result that the options name.

    Raises:
        InputError: the result has no bodies, or none of these tracks, or bodies of another model; or the config uses no
            bodies, or fixes the shape, which the bodies of the result do not.
    """
    from jaxfit.data.solution import load_solution
    from jaxfit.fitting.bodies import bodies_of

    if options.body is None:
        return None
    if config.body_stage is None:
        problem = "has no stage that uses the body of a bird"
        raise InputError(f"config {options.config}", problem, "choose a config with `share_body`, such as `map`")
    solution, own = load_solution(options.body)
    same = own.joint_names == bird.joint_names
    same = same and all(np.array_equal(getattr(own, name), getattr(bird, name)) for name in ("joints", "shape_basis"))
    if not same:
        raise InputError(options.body, f"has the bodies of another model, {own.name}", "give a result of this model")
    bodies = bodies_of(solution, bird, config)
    has_shapes = any(body.betas.any() for body in bodies.values())
    if has_shapes and "betas" not in config.stages[config.body_stage].optimised:
        problem = "has bodies with a shape, but no stage of the config shares the shape"
        raise InputError(options.body, problem, "choose a config that shares `betas`, such as `map`")
    if not bodies.keys() & set(tracks):
        known = f"has the bodies of tracks {sorted(bodies)}" if bodies else "has no bodies"
        raise InputError(options.body, known, f"give a result with bodies of tracks {tracks}")
    return bodies


def _write_fit(
    options: argparse.Namespace,
    config: FitConfig,
    bird: Bird,
    solution: Solution,
    views: Views | None,
    seconds: dict[str, float],
    facts: dict[str, Any],
    subject: str,
    learnt: str | None = None,
) -> None:
    """Place the birds on the ledge if the options ask for this, write the result and print its tables.

    Args:
        options: the options of the command.
        config: the config of the fit.
        bird: the model.
        solution: the poses.
        views: the calibrated cameras; None without.
        seconds: time of each part of the work.
        facts: more entries of `summary.json`.
        subject: the number of birds or tracks, for the last line.
        learnt: text of `learnt.yaml`.

    Raises:
        InputError: the birds could not be placed on the ledge; the result was written without.
    """
    from jaxfit.cameras.files import write_cameras
    from jaxfit.config.yaml_file import config_to_yaml
    from jaxfit.data.result_folder import CAMERAS, POSES
    from jaxfit.data.solution import write_solution
    from jaxfit.fitting.collect import summarise
    from jaxfit.foundation.files import new_folder

    source = options.observations if views is None else ", ".join(map(str, options.observations))
    placed, failure = place_if_wanted(options, solution, bird, views, source)
    cameras = () if views is None else views.lenses
    if placed is not None:
        solution, cameras = placed.solution, placed.cameras
        facts = facts | {"ledge": placed.facts}
    summary = summarise(solution, bird, seconds) | facts
    with new_folder(options.out, options.overwrite, marker=POSES) as part:
        write_solution(solution, bird, config_to_yaml(config), summary, part, learnt)
        if cameras:
            write_cameras(cameras, part / CAMERAS)
    _show_fit(solution)
    if placed is not None:
        show_ledge(placed.facts)
    if cameras:
        show_world(solution)
    counts = ", ".join(f"{count} {status}" for status, count in summary["status"].items())
    poses = counted(summary["poses"], "pose")
    show(f"{poses} of {subject} ({counts}) in {seconds['fit']:.1f} s → {options.out}")
    if failure is not None:
        raise failure


def _check_one_camera(options: argparse.Namespace) -> None:
    """Raise InputError if options for several cameras are given without cameras."""
    for option in ("unit", "offsets", "match"):
        if getattr(options, option) is not None:
            raise InputError(f"--{option}", "is given without --cameras", "give the calibrated cameras by --cameras")
    if len(options.observations) > 1:
        problem = f"{len(options.observations)} files of observations without --cameras"
        raise InputError("fit", problem, "give the calibrated cameras by --cameras, or fit the files one by one")


def _show_fit(solution: Solution) -> None:
    """Print the table of a fit."""
    show(flag_line(solution))
    table = right_aligned("track", "frames", "objective", *FIT_COLUMNS[:-1])
    table.add_column(FIT_COLUMNS[-1])
    total, cells = np.sum(list(solution.loss.values()), axis=0), fit_cells(solution)
    for n, track in enumerate(solution.track_id.tolist()):
        frames = int(solution.valid[n].sum())
        table.add_row(str(track), str(frames), f"{total[n] / max(frames, 1):.1f}", *cells[track])
    table.title = "objective: final value per frame; ok, unsure, contradicted: poses with this flag"
    show(table)


def _fit_views(options: argparse.Namespace, config: FitConfig, bird: Bird, start: float) -> None:
    """Fit the birds that calibrated cameras see and write a result."""
    from jaxfit.cli.cameras import read_views, show_matches
    from jaxfit.fitting.ledge_plane import plane_of
    from jaxfit.fitting.views import fit_views, with_unit
    from jaxfit.foundation.workers import open_cluster
    from jaxfit.model.bird import rest_length

    if options.init is not None:
        raise InputError("--init", "is given with --cameras", "leave out --init: the cameras give the initial poses")
    read = read_views(options, bird)
    show_matches(read)
    if options.ledge == WORLD:
        plane_of(read.views.lenses[0], options.cameras)  # before the long work
    source = ", ".join(map(str, options.observations))
    measured, facts = with_unit(read.views, bird, source), {}
    if bird.metres_per_unit is None:
        length_cm = 100 * rest_length(measured) * (measured.metres_per_unit or 1.0)
        facts["measured_length_cm"] = round(length_cm, 2)
        show(f"model {bird.name} has no unit of length: measured by the cameras, bill to tail {length_cm:.1f} cm")
    bird = measured
    tracks = np.unique(np.concatenate([own.track_id for own in read.views.observations])).tolist()
    bodies = _known_bodies(options, config, bird, tracks)
    read_s = time.perf_counter() - start
    with open_cluster(options.workers, options.scheduler) as cluster:
        solution = fit_views(read.views, bird, config, terminal, source, cluster, bodies)
    seconds = {"read": read_s, "fit": time.perf_counter() - start - read_s}
    lenses, matches = read.views.lenses, read.matches
    matched = {
        f"bird {b + 1}": {
            camera.name: tracks.track_id[(bird_of_track == b).any(axis=1)].tolist()
            for camera, tracks, bird_of_track in zip(lenses, read.tracks, matches.bird, strict=True)
        }
        for b in range(matches.birds)
    }
    facts |= {"cameras": [camera.name for camera in lenses], "matches": matched}
    subject = f"{counted(len(solution.track_id), 'bird')} in {counted(len(read.tracks), 'view')}"
    _write_fit(options, config, bird, solution, read.views, seconds, facts, subject)


def _fewer_keypoints(config: FitConfig, names: NameMap, options: argparse.Namespace) -> FitConfig:
    """Return a config that requires no more keypoints per frame than the file has.

    Raises:
        InputError: fewer keypoints than an orientation needs.
    """
    count = len(names.mapped)
    if count >= config.min_keypoints:
        return config
    if count < MIN_KEYPOINTS:
        problem = f"has {count} keypoints of the model by name; a fit needs {MIN_KEYPOINTS}"
        raise InputError(options.observations, problem, "map more names by --names MAP.yaml")
    show(f"min_keypoints is {count} instead of {config.min_keypoints}, because the file has {count} keypoints")
    return replace(config, min_keypoints=count)


def evaluate(options: argparse.Namespace) -> None:
    """Compare a result or observations with the truth and print metrics."""
    from jaxfit.cli.observations import matching_line
    from jaxfit.data.keypoint_names import map_keypoints
    from jaxfit.data.solution import load_solution
    from jaxfit.evaluation.evaluate import evaluate
    from jaxfit.evaluation.truth import match_tracks, read_truth

    if options.plot and not options.calibration:
        raise InputError("--plot", "is given without --calibration", "add --calibration, or remove --plot")
    if os.path.isfile(options.result):  # noqa: PTH113 - False for paths that cannot exist
        for option, given in (("--by behaviour", options.by == "behaviour"), ("--calibration", options.calibration)):
            if given:
                remedy = f"give the folder of a result, or remove {option}"
                raise InputError(options.result, f"holds observations, for which there are no tables {option}", remedy)
        _evaluate_observations(options)
        return
    solution, bird = load_solution(options.result)
    # a fit of photographs has one frame, see `fit`
    untracked = "photographs" if len(solution.frame_index) == 1 else "video"
    truth = read_truth(options.truth, options.video, image_size(options), untracked)
    true_names = truth.observations.keypoint_names
    if not true_names:
        remedy = f"compare the detections that were fitted: jaxfit evaluate OBS.json --truth {options.truth}"
        raise InputError(options.truth, "has masks but no keypoints, by which poses are compared", remedy)
    if set(true_names) != set(bird.keypoint_names):
        names = keypoint_map(true_names, options.truth, bird.keypoint_names, options.names, quiet=options.json)
        truth = replace(truth, observations=map_keypoints(truth.observations, names, bird.keypoint_names))
    if options.by == "behaviour" and truth.behaviours is None:
        remedy = "give the folder of a simulated scene, or remove --by behaviour"
        raise InputError(options.truth, "holds no behaviours of the birds", remedy)
    solution, matching = match_tracks(solution, truth, options.match)
    if options.calibration:
        _calibration(options, solution, truth)
        return
    result = evaluate(solution, bird, truth, terminal)
    if options.json:
        matched = {"matched_by": matching.by, "follows": matching.follows}
        print(json_text(result.to_dict() | matched))  # noqa: T201
        return
    follows = matching.follows if matching.by == "overlap" else None
    for table in evaluation_tables(result, follows):
        show(table)
    for table in breakdown_tables(result, options.by) if options.by else []:
        show(table)
    if matching.by == "overlap":
        show(matching_line(matching))
    for line in filter(None, (_missing_space(options), wrong_poses_line(result, follows), flag_quality_line(result))):
        show(line)
    if result.missing:
        show(f"not counted: {counted(result.missing, 'annotated bird')} without a pose in this result")
    if result.unmatched:
        show(f"not counted: {counted(result.unmatched, 'pose')} of tracks or frames that the truth lacks")


def _missing_space(options: argparse.Namespace) -> str:
    """Return why the annotations of a simulated scene give no metrics in space; empty text for other truths."""
    from jaxfit.data.formats import TRUE_POSES, TRUTH

    if options.truth.name != TRUTH:
        return ""
    poses = options.truth.with_name(TRUE_POSES)
    if not poses.is_dir():
        return f"no metrics in space: there is no folder {TRUE_POSES} with the true poses beside {options.truth}"
    return f"no metrics in space: the true poses are in {poses}: give --truth {poses.parent}"


def _calibration(options: argparse.Namespace, solution: Solution, truth: Truth) -> None:
    """Print the calibration of the error bars of a result, and plot it."""
    from jaxfit.evaluation.calibration import calibration, plot_calibration
    from jaxfit.foundation.extras import require_extra
    from jaxfit.foundation.files import check_writable

    if options.plot:
        require_extra("report", "--plot")
        check_writable(options.plot)
    result = calibration(solution, truth)
    if options.plot:
        plot_calibration(result, options.plot)
    if options.json:
        print(json_text(result.to_dict()))  # noqa: T201
        return
    for table in calibration_tables(result):
        show(table)
    show("50 %, 68 %, 95 %: errors inside the region of this probability;")
    show("sd: mean standard deviation; error: RMS error of a component; NLL: mean negative log-likelihood, nats;")
    show("constant: NLL of a constant bar for each keypoint or joint that is fitted to the errors")
    if result.without_error_bars:
        show(f"not counted: {counted(result.without_error_bars, 'pose')} without error bars")


def _evaluate_observations(options: argparse.Namespace) -> None:
    """Compare observations with the truth and print detection, keypoint and tracking metrics."""
    from dataclasses import asdict

    from jaxfit.cli.observations import observation_tables, uncounted_lines
    from jaxfit.data.formats.recognise import read_observations
    from jaxfit.data.keypoint_names import map_keypoints, propose_names
    from jaxfit.evaluation.tracking import evaluate_observations
    from jaxfit.evaluation.truth import read_truth

    truth = read_truth(options.truth, options.video, image_size(options))
    observations = read_observations(options.result, options.video, image_size(options))
    true_names = truth.observations.keypoint_names
    if options.names or propose_names(observations.keypoint_names, true_names).mapped:
        own_names = observations.keypoint_names
        names = keypoint_map(own_names, options.result, true_names, options.names, quiet=options.json)
        # keypoints that only one of the files has are not compared
        observations = map_keypoints(observations, names, list(names.mapped.values()))
    result = evaluate_observations(observations, truth)
    if options.json:
        keypoints = {name: row._asdict() for name, row in result.keypoints.items()}
        print(json_text(asdict(result) | {"keypoints": keypoints}))  # noqa: T201
        return
    for table in observation_tables(result):
        show(table)
    for line in uncounted_lines(result):
        show(line)


def overlay(options: argparse.Namespace) -> None:
    """Draw a result on its video, or on one frame of its video."""
    from jaxfit.data.result_folder import check_is_of_video, read_summary
    from jaxfit.data.solution import load_solution
    from jaxfit.data.world import as_filmed
    from jaxfit.view.overlay import overlay, overlay_frame

    solution, bird = load_solution(options.result)
    check_is_of_video(options.result, read_summary(options.result), "`jaxfit report` says how to draw photographs")
    solution, lens = as_filmed(options.result, solution, bird, options.camera)
    observations = None
    if options.observations:
        observations, _ = observations_for(options.observations, solution.keypoint_names, options)
    settings = {
        "observations": observations,
        "side_views": options.side_views,
        "overwrite": options.overwrite,
        "force": options.force,
        "lens": lens,
    }
    if options.frame is not None:
        overlay_frame(solution, bird, options.video, options.frame, options.out, **settings)
        show(f"frame {options.frame} → {options.out}")
        return
    overlay(solution, bird, options.video, options.out, codec=options.codec, progress=terminal, **settings)
    show(f"overlay → {options.out}, contact sheet → {options.out.with_suffix('.png')}")
