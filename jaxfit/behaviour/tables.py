"""Files of what birds do: features of every frame, bouts, time budgets, for R, pandas, movement and BORIS."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.behaviour.bouts import LEVEL, Budget, Ethogram
from jaxfit.behaviour.describe import Description
from jaxfit.behaviour.rules import BehaviourConfig
from jaxfit.export.pose_files import movement_dataset, netcdf
from jaxfit.export.result import Exported
from jaxfit.export.tables import Columns, csv_table, parquet_table, row_columns
from jaxfit.foundation.reading import json_text

SD_NOTE = (
    "standard deviation, from the error bars of the fit, as if the errors of different angles were independent; none "
    "for features that compare frames"
)
"""Definition of the standard deviations."""


def feature_columns(exported: Exported, description: Description, ethogram: Ethogram | None) -> Columns:
    """Return a row for each bird and frame: track, frame, time, fitted, flag, behaviour, features."""
    columns = row_columns(exported)
    del columns["status"], columns["doubts"]
    columns["flag"][columns["flag"] == ""] = None
    if ethogram is not None:
        columns["behaviour"] = np.array([*ethogram.names, None], object)[ethogram.state].reshape(-1)
    for feature in description.features:
        name, values = feature.column(description.flock.unit), description.values[feature.name].reshape(-1)
        columns[name] = description.tracks(feature.name).reshape(-1) if feature.unit == "id" else values
        if feature.name in description.sd:
            columns[sd_column(name, feature.name)] = description.sd[feature.name].reshape(-1)
    return columns


def sd_column(column: str, name: str) -> str:
    """Return the name of the column of standard deviations: `body_pitch_sd_deg` of `body_pitch_deg`."""
    return f"{name}_sd{column[len(name) :]}"


def _text_cell(text: str) -> str:
    """Return a text that a spreadsheet does not take for a formula."""
    return f"'{text}" if text[:1] in tuple("=+-@") else text


def bout_columns(exported: Exported, description: Description, ethogram: Ethogram, config: BehaviourConfig) -> Columns:
    """Return a row for each bout, with the columns of the aggregated events of BORIS, and the means of the features.

    Source: BORIS 10, `export_events.py`: names and order of the columns.
    """
    s, bouts, video, fps = exported.solution, ethogram.bouts, exported.video, exported.fps
    length_s = None if fps is None or not len(s.frame_index) else (int(s.frame_index[-1]) + 1) / fps
    duration = {n: sum(each.stop_s - each.start_s for each in bouts if each.bird == n) for n in range(len(s.track_id))}

    def every(value: Any) -> np.ndarray:
        return np.full(len(bouts), value, object)

    def of_bouts(value: Callable[[Any], Any]) -> np.ndarray:
        return np.array([value(each) for each in bouts], object)

    columns: Columns = {
        "Observation id": every(_text_cell(exported.source.name)),
        "Observation date": every(None),
        "Description": every("found by jaxfit"),
        "Observation type": every("Media file" if video else "Live observation"),
        "Source": every(f"player #1:{video}" if video else None),
        "Time offset (s)": every(0.0),
        "Coding duration": every(length_s),
        "Media duration (s)": every(length_s),
        "FPS (frame/s)": every(fps),
        "Subject": of_bouts(lambda each: f"bird_{s.track_id[each.bird]}"),
        "Observation duration by subject by observation": of_bouts(lambda each: round(duration[each.bird], 3)),
        "Behavior": of_bouts(lambda each: each.behaviour),
        "Behavioral category": every("Not defined"),
        "Modifier #1": of_bouts(lambda each: None if each.partner is None else f"bird_{each.partner}"),
        "Behavior type": every("STATE"),
        "Start (s)": of_bouts(lambda each: round(each.start_s, 3)),
        "Stop (s)": of_bouts(lambda each: round(each.stop_s, 3)),
        "Duration (s)": of_bouts(lambda each: round(each.stop_s - each.start_s, 3)),
        "Media file name": every(_text_cell(str(video)) if video else None),
        "Image index start": of_bouts(lambda each: int(s.frame_index[each.frames.start])),
        "Image index stop": of_bouts(lambda each: int(s.frame_index[each.frames.stop - 1])),
        "Image file path start": every(None),
        "Image file path stop": every(None),
        "Comment start": of_bouts(lambda each: _text_cell(config.behaviours[each.behaviour].definition)),
        "Comment stop": every(None),
    }
    for feature in description.features:
        if feature.unit != "id":
            name = f"mean_{feature.column(description.flock.unit)}"
            columns[name] = np.array([each.means[feature.name] for each in bouts], np.float32)
    return columns


def budget_columns(budget: Sequence[Budget]) -> Columns:
    """Return a row for each bird and behaviour; the bird `all` stands for all birds together."""

    def column(value: Callable[[Budget], Any]) -> np.ndarray:
        return np.array([value(row) for row in budget], object)

    return {
        "bird": column(lambda row: "all" if row.track is None else f"bird_{row.track}"),
        "behaviour": column(lambda row: row.behaviour),
        "seconds": np.array([row.seconds for row in budget], np.float32),
        "share": np.array([row.share for row in budget], np.float32),
        f"share_low_{LEVEL * 100:.0f}": np.array([row.low for row in budget], np.float32),
        f"share_high_{LEVEL * 100:.0f}": np.array([row.high for row in budget], np.float32),
        "bouts": np.array([row.bouts for row in budget], np.int64),
    }


def boris_project(exported: Exported, ethogram: Ethogram, config: BehaviourConfig) -> bytes:
    """Return a project that BORIS opens: an ethogram, the birds as subjects, and one observation with all bouts.

    Source: BORIS 10, `config.py` (`EMPTY_PROJECT`): version 7.0 of the format.
    """
    s, video = exported.solution, exported.video
    shown = [name for name in ethogram.names if name in config.behaviours]
    events: list[list[Any]] = []
    for each in ethogram.bouts:
        subject = f"bird_{s.track_id[each.bird]}"
        modifier = "" if each.partner is None else f"bird_{each.partner}"
        for time_s, at in ((each.start_s, each.frames.start), (each.stop_s, each.frames.stop - 1)):
            row = [round(time_s, 3), subject, each.behaviour, modifier, ""]
            events.append([*row, int(s.frame_index[at])] if video else row)
    events.sort(key=lambda row: row[0])
    partners = [f"bird_{track}" for track in s.track_id.tolist()]
    modifiers = {"0": {"name": "partner", "description": "", "type": 0, "values": partners, "ask at stop": False}}
    behaviours = {
        str(i): {
            "type": "State event",
            "key": "",
            "code": name,
            "description": config.behaviours[name].definition,
            "color": "",
            "category": "",
            "modifiers": modifiers if config.behaviours[name].partner else {},
            "excluded": "",
            "coding map": "",
        }
        for i, name in enumerate(shown)
    }
    project = {
        "time_format": "s",
        "project_date": "1970-01-01T00:00:00",
        "project_name": exported.source.name,
        "project_description": "behaviour of birds, found by jaxfit",
        "project_format_version": "7.0",
        "subjects_conf": {str(i): {"key": "", "name": name, "description": ""} for i, name in enumerate(partners)},
        "behaviors_conf": behaviours,
        "observations": {exported.source.name: _boris_observation(exported, events)},
        "behavioral_categories": [],
        "behavioral_categories_config": {},
        "independent_variables": {},
        "coding_map": {},
        "behaviors_coding_map": [],
        "converters": {},
    }
    return json.dumps(project, ensure_ascii=False, indent=1).encode()


def _boris_observation(exported: Exported, events: list[list[Any]]) -> dict[str, Any]:
    """Return one observation of a project for BORIS."""
    s, video = exported.solution, exported.video
    media = {} if video is None else {"1": [str(video)]}
    media_info: dict[str, Any] = {}
    if video is not None and exported.fps:
        length = (int(s.frame_index[-1]) + 1) / exported.fps
        media_info = {"length": {str(video): length}, "fps": {str(video): exported.fps}}
        media_info |= {"hasVideo": {str(video): True}, "hasAudio": {str(video): False}, "offset": {"1": 0.0}}
    return {
        "file": media,
        "type": "LIVE" if video is None else "MEDIA",
        "date": "1970-01-01T00:00:00",
        "description": "found by jaxfit; the date of the film is unknown and stored as 1970-01-01",
        "time offset": 0.0,
        "events": events,
        "observation time interval": [0, 0],
        "independent_variables": {},
        "visualize_spectrogram": False,
        "visualize_waveform": False,
        "close_behaviors_between_videos": False,
        "media_info": media_info,
    }


def about_columns(description: Description) -> dict[str, dict[str, str]]:
    """Return column → its unit and its definition."""
    about = {}
    for feature in description.features:
        unit, name = feature.shown_unit(description.flock.unit), feature.column(description.flock.unit)
        about[name] = {"unit": unit, "definition": feature.definition}
        if feature.name in description.sd:
            about[sd_column(name, feature.name)] = {"unit": unit, "definition": SD_NOTE}
    return about


def facts_of(exported: Exported, description: Description) -> dict[str, str]:
    """Return facts about a whole table of features, for its metadata."""
    lengths = "metres" if description.flock.unit == "m" else "body lengths (the model at rest, bill tip to tail tip)"
    return {
        "source_software": "jaxfit",
        "unit_of_lengths": lengths,
        "model": exported.bird.name,
        "fps": str(exported.fps or "unknown"),
        "notes": json_text(list(description.flock.notes)),
    }


def features_file(path: Path, exported: Exported, description: Description, ethogram: Ethogram | None) -> bytes:
    """Return the file of features: CSV, Parquet or netCDF, by the end of its name.

    The netCDF file is a data set `poses` of movement: positions of the keypoints (in the world if the result has one,
    else in the image), and the features as variables (time, individual).

    Raises:
        InputError: another end of the name, a missing package, or an unknown frame rate for netCDF.
    """
    if path.suffix.lower() == ".nc":
        return _movement_file(exported, description, ethogram)
    columns = feature_columns(exported, description, ethogram)
    if path.suffix.lower() == ".parquet":
        return parquet_table(columns, facts_of(exported, description), about_columns(description))
    return csv_table(columns, {})


def _movement_file(exported: Exported, description: Description, ethogram: Ethogram | None) -> bytes:
    dataset = movement_dataset(exported, "world" if exported.solution.world is not None else "2d")
    numbers = np.asarray(dataset["frame"])
    column = np.searchsorted(numbers, exported.solution.frame_index)
    about = about_columns(description)

    def in_time(values: np.ndarray, empty: Any) -> np.ndarray:
        arranged = np.full((len(numbers), values.shape[0]), empty, values.dtype)
        arranged[column] = values.T
        return arranged

    for feature in description.features:
        name = feature.column(description.flock.unit)
        is_track = feature.unit == "id"
        arrays = {name: description.values[feature.name]}
        if is_track:  # names of individuals, as in `movement_dataset`
            tracks = description.tracks(feature.name)
            arrays[name] = np.array([["" if n is None else f"bird_{n}" for n in row] for row in tracks], str)
        if feature.name in description.sd:
            arrays[sd_column(name, feature.name)] = description.sd[feature.name]
        for key, values in arrays.items():
            facts = {"units": about[key]["unit"], "description": about[key]["definition"]}
            dataset[key] = (("time", "individual"), in_time(values, "" if is_track else np.nan), facts)
    if ethogram is not None:
        states = np.array([*ethogram.names, ""])[ethogram.state]
        dataset["behaviour"] = (("time", "individual"), in_time(states, ""), {"description": "empty: no pose"})
    dataset.attrs |= facts_of(exported, description)
    return netcdf(dataset)
