"""`correct_tracks`: a result with corrected tracks, in a folder of its own."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxfit.config.fit import FitConfig, load_config
from jaxfit.config.reconstruct import ReconstructConfig, load_reconstruct_config
from jaxfit.corrections.edits import Edit, apply_edits
from jaxfit.corrections.refit import Refit, refit
from jaxfit.data.formats.coco import write_coco
from jaxfit.data.formats.fields import read_json
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.observations import Observations, check_keypoints
from jaxfit.data.solution import Solution, load_solution, write_solution
from jaxfit.data.track_quality import track_quality
from jaxfit.errors import InputError
from jaxfit.fitting.summary import summarise
from jaxfit.limits import CONFIG_BYTES
from jaxfit.model.bird import Bird
from jaxfit.progress import ProgressTask, silent
from jaxfit.storage.files import check_replaceable, new_folder
from jaxfit.storage.reading import read_file

__all__ = [
    "CONFIG",
    "MARKER",
    "OBSERVATIONS",
    "Tracks",
    "correct_tracks",
    "read_config",
    "read_summary",
    "read_tracks",
]

OBSERVATIONS, CONFIG, MARKER = "observations.json", "config.yaml", "poses.npz"
_SUMMARY = "summary.json"
_KEPT = ("video", "trust", "trust_reasons", "networks")
"""Entries of the summary that corrections do not change."""


class Tracks(NamedTuple):
    """A result with the observations that it was fitted to."""

    solution: Solution
    bird: Bird
    observations: Observations


def read_tracks(result: str | Path, observations: str | Path | None = None) -> Tracks:
    """Read a result and its observations.

    Args:
        result: folder of `jaxfit reconstruct` or `jaxfit fit`.
        observations: the file that `jaxfit fit` was given; None takes `observations.json` of the folder.

    Raises:
        InputError: the files cannot be read, or do not belong together.
    """
    folder = Path(result)
    solution, bird = load_solution(folder)
    path = folder / OBSERVATIONS if observations is None else Path(observations)
    if observations is None and not path.is_file():
        problem = f"holds no {OBSERVATIONS}, because `jaxfit fit` does not copy the observations"
        raise InputError(folder, problem, "give the observations of the fit by --observations")
    read = check_keypoints(read_observations(path), bird.keypoint_names, path)
    same = np.array_equal(read.frame_index, solution.frame_index)
    if not (same and np.array_equal(np.sort(read.track_id), np.sort(solution.track_id))):
        raise InputError(path, f"has other tracks or frames than {folder}", "give the file that was fitted")
    return Tracks(solution, bird, read)


def correct_tracks(
    result: str | Path,
    out: str | Path,
    edits: Sequence[Edit],
    observations: str | Path | None = None,
    overwrite: bool = False,
    progress: ProgressTask = silent,
) -> Refit:
    """Correct the tracks of a result, fit the windows that change, and write the new result.

    The folder holds the files of `jaxfit fit` and the corrected `observations.json`. `corrections` in `summary.json`
    lists the edits.

    Args:
        result: folder of the earlier result, which stays as it is.
        out: folder for the new result.
        edits: the corrections, one after the other.
        observations: the observations of the earlier result, see `read_tracks`.
        overwrite: replace an earlier result in `out`.
        progress: shows progress.

    Raises:
        InputError: as `read_tracks`, `apply_edits` and `jaxfit.fit`; or `out` is the folder of the earlier result,
            holds other files or cannot be written.
    """
    folder, out, start = Path(result), Path(out), time.perf_counter()
    if out.resolve() == folder.resolve():
        raise InputError(out, "is the result itself, which corrections keep", "choose another --out")
    check_replaceable(out, overwrite, MARKER)
    tracks = read_tracks(folder, observations)
    corrected = apply_edits(tracks.observations, edits, folder)
    config, config_text = read_config(folder)
    fit_config = config.fit if isinstance(config, ReconstructConfig) else config
    done = refit(tracks.solution, tracks.observations, corrected, tracks.bird, fit_config, progress, folder)
    summary: dict[str, Any] = summarise(done.solution, tracks.bird, {"fit": time.perf_counter() - start})
    earlier = read_summary(folder)
    summary |= {key: value for key, value in earlier.items() if key in _KEPT}
    summary["quality"] = {row.track_id: row._asdict() for row in track_quality(corrected)}
    summary["corrections"] = [*earlier.get("corrections", []), *map(str, edits)]
    with new_folder(out, overwrite, marker=MARKER) as part:
        write_coco(corrected, part / OBSERVATIONS)
        write_solution(done.solution, tracks.bird, config_text, summary, part)
    return done


def read_config(folder: Path) -> tuple[FitConfig | ReconstructConfig, str]:
    """Return the config of a result, of a fit or of a reconstruction, and the text of its file."""
    path = folder / CONFIG
    text = read_file(path, CONFIG_BYTES, "a config").decode("utf-8", "replace")
    is_reconstruction = any(line.startswith("fit:") for line in text.splitlines())
    return (load_reconstruct_config(path) if is_reconstruction else load_config(path)), text


def read_summary(folder: Path) -> dict[str, Any]:
    """Return the content of `summary.json` of a result; empty if the file is absent."""
    path = folder / _SUMMARY
    value = read_json(path).value if path.is_file() else {}
    return value if isinstance(value, dict) else {}
