"""`import`, `dataset`; observations of any format for a command, and their tables."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from jaxfit.cli.tables import EscapedTable, right_aligned, show, show_facts, track_table
from jaxfit.config.yaml_file import read_yaml_file
from jaxfit.data.formats.coco_records import Untracked
from jaxfit.data.keypoint_names import NameMap, checked_map, map_keypoints, propose_names
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError, counted
from jaxfit.foundation.progress import terminal

if TYPE_CHECKING:
    from jaxfit.evaluation.tracking import ObservationsEvaluation
    from jaxfit.evaluation.truth import Matching


def observations_for(
    path: Path,
    model_names: Sequence[str],
    options: argparse.Namespace,
    quiet: bool = False,
    untracked: Untracked = "video",
) -> tuple[Observations, NameMap]:
    """Return the observations of a file with the keypoints of a model, by `--names` or by a proposal, and this map.

    Args:
        path: the file.
        model_names: names of the keypoints of the model.
        options: the options `video`, `size` and `names` of the command.
        quiet: whether to print no table.
        untracked: how a COCO file without any track is read; see `jaxfit.data.formats.coco_records`.

    Raises:
        InputError: as `read_observations`; an unusable map, or no keypoint of the model.
    """
    from jaxfit.data.formats.recognise import read_observations  # imports the video libraries

    observations = read_observations(path, options.video, image_size(options), untracked)
    names = keypoint_map(observations.keypoint_names, path, model_names, options.names, quiet)
    return map_keypoints(observations, names, model_names), names


def keypoint_map(
    own: Sequence[str], path: Path, model_names: Sequence[str], map_file: Path | None, quiet: bool = False
) -> NameMap:
    """Return the map from the keypoints `own` of a file to those of a model; otherwise as `observations_for`."""
    if map_file is not None:
        names = checked_map(_read_map(map_file), own, model_names, map_file)
    else:
        names = propose_names(own, model_names)
    if not names.mapped:
        problem = f"has no keypoint of the model by name: it has {', '.join(own)}"
        raise InputError(path, problem, "map the names by --names MAP.yaml")
    if names.changes_names and not quiet:
        how = "mapped by --names" if map_file is not None else "mapped by their words; --names MAP.yaml changes the map"
        show_names(names, path.name, how)
    return names


def image_size(options: argparse.Namespace) -> tuple[int, int] | None:
    """Return width and height of the option `size`, see `parsed_size`; None without the option."""
    return None if options.size is None else parsed_size(options.size)


def parsed_size(text: str) -> tuple[int, int]:
    """Return width and height in pixels from the text of `--size`, such as `640x480`.

    Raises:
        InputError: the text is not two positive whole numbers.
    """
    width, _, height = text.lower().replace("×", "x").partition("x")
    if not all(side.isascii() and side.isdecimal() and 1 <= len(side) <= 5 and int(side) for side in (width, height)):
        raise InputError("--size", f"is {text}", "give width and height in pixels, such as 640x480")
    return int(width), int(height)


def show_names(names: NameMap, source: str, how: str) -> None:
    """Print the map of the names of a source as a table, or only the unused keypoints if no name changes."""
    if all(old == new for old, new in names.mapped.items()):
        show(f"keypoints of {source} that are not used: {', '.join(names.unmapped)}")
        return
    table = EscapedTable()
    table.add_column("in the file")
    table.add_column("in the model")
    for old, new in names.mapped.items():
        table.add_row(old, new)
    for old in names.unmapped:
        table.add_row(old, "– (not used)")
    show(f"keypoints of {source}, {how}:")
    show(table)
    if names.missing:
        show(f"keypoints of the model that the file lacks: {', '.join(names.missing)}")


def _read_map(path: Path) -> dict[str, str | None]:
    """Return the map of a YAML file with one line `name in the file: name in the model` for every keypoint."""
    remedy = "write lines such as `beak: bill_tip`; null leaves a keypoint out"
    value = read_yaml_file(path).values
    if not value:
        raise InputError(path, "holds no map of names", remedy)
    for old, new in value.items():
        if not (new is None or isinstance(new, str)):
            raise InputError(path, f"maps {old!r} to {str(new)[:40]!r}, which is not a name", remedy)
    return value


_DETECTION = {
    "ap50": "AP50",
    "ap50-95": "AP50-95",
    "precision": "precision",
    "recall": "recall",
    "mean_iou": "mean IoU",
}
_TRACKING = {
    "hota": "HOTA",
    "deta": "DetA",
    "assa": "AssA",
    "mota": "MOTA",
    "idf1": "IDF1",
    "switches": "id switches",
    "fragments": "fragments",
}


def observation_tables(result: ObservationsEvaluation) -> list[Table]:
    """Return tables of detection, keypoint and tracking metrics; no keypoint table if the files share no keypoint."""
    birds = right_aligned("frames", "birds", "detected", *_DETECTION.values())
    counts = (str(result.counts[name]) for name in ("frames", "true", "detected"))
    birds.add_row(*counts, *(_fraction(result.detection[name]) for name in _DETECTION))
    birds.caption = (
        f"{result.compared} match if their IoU is at least 0.5; AP ranks detections by score; the other metrics use "
        "all detections in the file; mean IoU: over the matches"
    )
    tables = [birds]
    if result.keypoints:
        points = right_aligned("keypoint", *["visible", "PCK@0.05", "PCK@0.10", "all", "PCK@0.05", "PCK@0.10"])
        points.columns[0].justify = "left"
        for name, row in result.keypoints.items():
            if name == "all":
                points.add_section()
            cells = (str(cell) if isinstance(cell, int) else _fraction(cell) for cell in row)
            points.add_row(name, *cells)
        points.caption = (
            "PCK: fraction of the matched birds' keypoints within 5 or 10 % of the longer side of the annotated box, "
            "for visible and for all keypoints; a missing keypoint counts as wrong"
        )
        tables.append(points)
    tracks = right_aligned(*_TRACKING.values())
    metrics = (result.tracking[name] for name in _TRACKING)
    tracks.add_row(*(str(metric) if isinstance(metric, int) else _fraction(metric) for metric in metrics))
    tracks.caption = "HOTA, DetA, AssA: means over IoU thresholds from 0.05 to 0.95; the other metrics: threshold 0.5"
    return [*tables, tracks]


def uncounted_lines(result: ObservationsEvaluation) -> list[str]:
    """Return lines that say which birds the metrics ignore, and why."""
    counts, lines = result.counts, []
    if counts["ignored"]:
        excused = f" and {counted(counts['excused'], 'detection')} of these birds" if counts["excused"] else ""
        lines.append(f"not counted: {counted(counts['ignored'], 'hardly visible bird')}{excused}")
    for name, missing in (("true_elsewhere", "the observations lack"), ("detected_elsewhere", "the truth lacks")):
        if counts[name]:
            lines.append(f"not counted: {counted(counts[name], 'bird')} in frames that {missing}")
    return lines


def matching_line(matching: Matching) -> str:
    """Return a line that says which annotated bird each track follows, for tracks that were matched by overlap."""
    pairs = ", ".join(f"{track} → {bird}" for track, bird in matching.follows.items()) or "none"
    strays = f"; tracks that follow no bird: {_listed(matching.unmatched)}" if matching.unmatched else ""
    lost = f"; birds that no track follows: {_listed(matching.missed)}" if matching.missed else ""
    return f"tracks matched by overlap and renamed to the ids of the truth: {pairs}{strays}{lost}"


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers))


def _fraction(value: float) -> str:
    return "–" if math.isnan(value) else f"{value:.4f}"


def import_observations(options: argparse.Namespace) -> None:
    """Convert a file of DeepLabCut, SLEAP, Lightning Pose or an annotation program to a COCO file."""
    from jaxfit.data.formats.coco import write_coco
    from jaxfit.data.formats.mask_files import add_masks
    from jaxfit.foundation.files import check_new_file, check_writable
    from jaxfit.model.files import find_bird

    check_new_file(options.out, options.overwrite)
    check_writable(options.out)
    bird = find_bird(options.model)
    observations, names = observations_for(options.file, bird.keypoint_names, options)
    if options.masks is not None:
        observations = add_masks(observations, options.masks, terminal, options.video)
    write_coco(observations, options.out, {"description": f"imported from {options.file.name}"})
    show(track_table(observations))
    total = int(observations.present.sum())
    mapped = f"{len(names.mapped)} of {counted(bird.num_keypoints, 'keypoint')} of the model"
    masks = f"{len(observations.masks):,} of {total:,} with a mask" if observations.masks else "no masks"
    tracks, frames = counted(observations.num_tracks, "track"), counted(observations.num_frames, "frame")
    if observations.photographs:  # every bird has a photograph of its own
        tracks = counted(observations.num_tracks, "bird")
        frames = counted(observations.photographs, "photograph")
    show(f"{tracks}, {frames}, {mapped}, {masks} → {options.out}")
    if not observations.masks:
        show("without masks, `jaxfit fit` compares keypoints only; --masks adds masks")


def murre(options: argparse.Namespace) -> None:
    """Convert common_murre_temporal to a COCO file and print how the layout was interpreted."""
    from jaxfit.data.formats.coco import write_coco
    from jaxfit.data.formats.common_murre import LICENSE, read_common_murre
    from jaxfit.foundation.files import check_new_file, check_writable
    from jaxfit.model.anatomy import MURRE_KEYPOINTS

    check_new_file(options.out, options.overwrite)
    check_writable(options.out)
    chosen = {"none": None, "murre": MURRE_KEYPOINTS}
    names = chosen[options.keypoints] if options.keypoints in chosen else options.keypoints.split(",")
    observations, readings = read_common_murre(options.folder, names, terminal)
    interpretation = "; ".join(f"{question}: {answer}" for question, answer in readings.items())
    info = {
        "description": f"common_murre_temporal; its layout is inferred, not published. {interpretation}",
        "license": LICENSE,
    }
    write_coco(observations, options.out, info)
    show("The layout of this data set is inferred, not published:")
    show_facts(readings)
    tracks, frames = counted(observations.num_tracks, "track"), counted(len(observations.frame_index), "frame")
    show(f"{tracks}, {frames} → {options.out} (licence {LICENSE}: no commercial use; the video itself is not read)")
