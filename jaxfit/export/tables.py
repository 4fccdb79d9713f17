"""Tables for R, pandas and spreadsheets, as CSV or Parquet: poses and keypoints, and joint angles.

Both tables have a row for every track and frame. A row without a pose has `fitted` = FALSE and empty values. The last
part of the name of a column is its unit: `s`, `px` (image pixels), `m` or `unit` (model units), `rad`. Positions in
space are those of a bird of the model's size in the camera frame of the image (`jaxfit.data.projection`). Results in a
world have the true size, and also positions in the world (`world_m`); on a ledge, also `on_ledge`.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from jaxfit.data.body_lengths import body_lengths
from jaxfit.data.flags import doubt_texts, flags
from jaxfit.data.world import in_frame_of_camera
from jaxfit.export.result import CONFIDENCE, ON_LEDGE, SD, TRIANGULATED, Exported
from jaxfit.foundation.extras import require_package
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ProgressTask
from jaxfit.foundation.reading import json_text

Columns = dict[str, np.ndarray]
"""Name → values of all rows; NaN and None are empty cells."""
_BLOCK = 5000
"""Rows that are texts at once."""


def write_csv(exported: Exported, out: Path, progress: ProgressTask) -> list[Path]:
    """Write both tables as CSV; returns their paths."""
    return _write(exported, out, csv_table, progress)


def write_parquet(exported: Exported, out: Path, progress: ProgressTask) -> list[Path]:
    """Write both tables as Parquet with units and definitions in the metadata; returns their paths.

    Raises:
        InputError: PyArrow is not installed.
    """
    return _write(exported, out, parquet_table, progress)


def angles_path(out: Path) -> Path:
    """Return the path of the table of joint angles: `birds.csv` has its angles in `birds_angles.csv`."""
    return out.with_name(f"{out.stem}_angles{out.suffix}")


def _write(
    exported: Exported, out: Path, content: Callable[[Columns, dict[str, str]], bytes], progress: ProgressTask
) -> list[Path]:
    facts = _facts(exported)
    tables = {out: _pose_columns(exported), angles_path(out): _angle_columns(exported)}
    with progress("Writing tables", len(tables)) as report_progress:
        for path, columns in tables.items():
            write_whole(path, content(columns, facts))
            report_progress(1, path.name)
    return list(tables)


def row_columns(exported: Exported) -> Columns:
    """Return the columns that all tables share: track, frame, time, fitted, status, flag and doubts."""
    s, doubts = exported.solution, exported.solution.flags.doubts
    N, T = s.valid.shape
    return {
        "track": np.repeat(s.track_id, T),
        "frame": np.tile(s.frame_index, N),
        "time_s": np.tile(exported.times_s, N),
        "fitted": s.valid.reshape(-1),
        "status": np.repeat(s.status.astype(object), T),
        "flag": flags(doubts).astype(object).reshape(-1),
        "doubts": np.array(["; ".join(doubt_texts(each)) for each in doubts.reshape(-1).tolist()], object),
    }


def _pose_columns(exported: Exported) -> Columns:
    """Return the quality of the track, position, orientation and size of the bird, and its keypoints."""
    s, unit, points = exported.solution, exported.unit, exported.keypoints_3d
    T = len(s.frame_index)
    columns = row_columns(exported)
    for name in ("coverage", "mean_confidence", "jitter"):
        rows = [exported.quality.get(track) for track in s.track_id.tolist()]
        values = [np.nan if row is None or getattr(row, name) is None else getattr(row, name) for row in rows]
        columns[f"track_{name}"] = np.repeat(np.array(values, np.float64), T)
    if s.bodies is not None:
        for name, length in body_lengths(exported.bird, s.bodies).items():
            column = f"body_{name.replace(' ', '_')}"
            columns |= {column: np.repeat(length.share, T), f"{column}_sd": np.repeat(length.sd, T)}
    columns |= _vectors(exported, {"root": exported.in_image.root * exported.length}, unit)
    columns |= _vectors(exported, {"orientation": exported.in_image.orientation}, "rad")
    if s.error_bars is not None:
        columns |= _vectors(exported, {"orientation": s.error_bars.global_orient_sd}, "sd_rad")
    columns["size"] = _known(exported, np.asarray(s.poses.scale))
    if s.contact is not None:
        columns["on_ledge"] = _known(exported, s.contact)
    confidence = exported.confidence
    sd_px, sd = exported.keypoints_px_sd, exported.keypoints_3d_sd
    for k, name in enumerate(s.keypoint_names):
        columns |= _vectors(exported, {name: s.keypoints.px[:, :, k]}, "px")
        columns[f"{name}_confidence"] = _known(exported, confidence[:, :, k])
        columns |= _vectors(exported, {name: points[:, :, k]}, unit)
        if sd_px is not None and sd is not None:
            columns |= _vectors(exported, {name: sd_px[:, :, k]}, "sd_px")
            columns |= _vectors(exported, {name: sd[:, :, k]}, f"sd_{unit}")
    if s.world is not None:
        world = {"root": s.world.transl_world_m} | {
            name: s.world.keypoints_world_m[:, :, k] for k, name in enumerate(s.keypoint_names)
        }
        for name, values in world.items():
            for i, axis in enumerate("xyz"):  # in float64: a world may have its origin far away
                columns[f"{name}_{axis}_world_m"] = np.where(s.valid, values[..., i], np.nan).reshape(-1)
    if s.triangulated is not None:
        for k, name in enumerate(s.keypoint_names):
            for end, values in (
                ("triangulated_m", s.triangulated.keypoints_triangulated_m),
                ("triangulated_sd_m", s.triangulated.keypoints_triangulated_sd_m),
            ):
                for i, axis in enumerate("xyz"):
                    columns[f"{name}_{axis}_{end}"] = values[:, :, k, i].reshape(-1)
    return columns


def _angle_columns(exported: Exported) -> Columns:
    """Return the rotation of every joint except the root relative to its parent, as axis-angles."""
    s = exported.solution
    angles = {name: np.asarray(s.poses.body_pose)[:, :, j] for j, name in enumerate(s.joint_names[1:])}
    columns = row_columns(exported) | _vectors(exported, angles, "rad")
    if s.error_bars is not None:
        sd = {name: s.error_bars.body_pose_sd[:, :, j] for j, name in enumerate(s.joint_names[1:])}
        columns |= _vectors(exported, sd, "sd_rad")
    return columns


def _vectors(exported: Exported, points: dict[str, np.ndarray], unit: str) -> Columns:
    """Return one column for each component of some vectors (N, T, 2 or 3)."""
    return {
        f"{name}_{axis}_{unit}": _known(exported, values[..., i])
        for name, values in points.items()
        for i, axis in enumerate("xyz"[: values.shape[-1]])
    }


def _known(exported: Exported, values: np.ndarray) -> np.ndarray:
    """Return values (N, T) as one column, NaN without a pose."""
    return np.where(exported.solution.valid, values, np.float32(np.nan)).astype(np.float32).reshape(-1)


def _facts(exported: Exported) -> dict[str, str]:
    """Return facts about the whole table, for its metadata."""
    units = {"s": "seconds", "px": "image pixels, origin at the upper left corner of the image", "rad": "radians"}
    units |= {"m": "metres"} if exported.unit == "m" else {"unit": "model units, whose length in metres is unknown"}
    frames = "positions: camera frame of the image, x right, y down, z forward; orientation: axis-angle, model to "
    frames += "camera; joint angles: axis-angle relative to the parent joint"
    return {
        "source_software": "jaxfit",
        "units": json_text(units),
        "frames": frames,
        "confidence": CONFIDENCE,
        "sd": SD,
        **_facts_of_space(exported),
        "model": exported.bird.name,
        "fps": str(exported.fps or "unknown"),
    }


def _facts_of_space(exported: Exported) -> dict[str, str]:
    """Return what is known about sizes and distances."""
    s, size = exported.solution, "size of the bird relative to the model in the result"
    owner, origin = "model", "assumed; depths are proportional to it"
    if in_frame_of_camera(s):
        owner, origin = "bird", "of the camera"
    facts = {
        "size": f"{size}; positions are those at the size of the {owner}",
        "focal_length_px": f"{exported.focal_px:.6g}, {origin}",
    }
    if s.world is not None:
        facts["world"] = f"{exported.world_frame}, metres"
    if s.triangulated is not None:
        facts["triangulated"] = TRIANGULATED
    return facts | ({} if s.contact is None else {"on_ledge": ON_LEDGE})


def csv_table(columns: Columns, _facts: dict[str, str], _about: Mapping[str, dict[str, str]] | None = None) -> bytes:
    """Return a table as CSV, as R and pandas read it without options: TRUE and FALSE; NaN is empty, None is NA."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    rows = len(next(iter(columns.values()), ()))
    for first in range(0, rows, _BLOCK):
        block = (_texts(values[first : first + _BLOCK]) for values in columns.values())
        writer.writerows(zip(*block, strict=True))
    return text.getvalue().encode()


def _texts(values: np.ndarray) -> list[Any]:
    """Return the cells of a column: the shortest digits that give the same number; nothing for NaN."""
    if values.dtype.kind == "f":
        return np.where(np.isnan(values), "", values.astype(str)).tolist()
    if values.dtype.kind == "b":
        return np.where(values, "TRUE", "FALSE").tolist()
    return ["NA" if value is None else value for value in values.tolist()]


def parquet_table(columns: Columns, facts: dict[str, str], about: Mapping[str, dict[str, str]] | None = None) -> bytes:
    """Return a table as Parquet.

    Args:
        columns: the columns.
        facts: metadata of the table.
        about: column → its metadata; None takes the unit from the end of the name.

    Raises:
        InputError: PyArrow is not installed.
    """
    require_package("pyarrow", "Parquet")
    import pyarrow
    import pyarrow.parquet

    fields, arrays = [], []
    for name, values in columns.items():
        array = pyarrow.array(values, from_pandas=True)  # NaN and None become null
        unit = name.rpartition("_")[2]
        metadata = {"unit": unit} if unit in ("s", "px", "m", "unit", "rad") else None
        fields.append(pyarrow.field(name, array.type, metadata=metadata if about is None else about.get(name)))
        arrays.append(array)
    table = pyarrow.Table.from_arrays(arrays, schema=pyarrow.schema(fields, metadata=facts))
    content = io.BytesIO()
    pyarrow.parquet.write_table(table, content)
    return content.getvalue()
