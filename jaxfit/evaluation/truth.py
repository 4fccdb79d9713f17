"""The truth that results are measured against: annotations and, where they are known, exact poses and behaviours."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from jaxfit.data.formats.coco import read_coco
from jaxfit.data.formats.coco_exports import Untracked
from jaxfit.data.formats.fields import read_json
from jaxfit.data.formats.recognise import read_observations
from jaxfit.data.formats.scene_folder import MARKER, TRUE_POSES, TRUTH
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution, load_solution
from jaxfit.errors import InputError
from jaxfit.model.bird import Bird

__all__ = ["Truth", "read_behaviours", "read_truth"]


@dataclass(frozen=True, eq=False)
class Truth:
    """The truth about the birds of one video."""

    observations: Observations
    """The annotations."""
    solution: Solution | None = None
    """The exact poses, in crops that are the real camera (see `SpatialErrors`); None where they are not known."""
    bird: Bird | None = None
    """The model of the exact poses; None stands for the model of the result."""
    behaviours: Mapping[int, Sequence[tuple[int, str]]] | None = None
    """Track id → pairs of a first frame and the behaviour that begins there, in the order of frames; the first pair
    begins with frame 0. None where behaviours are not known."""
    source: object = "truth"
    """The file or folder of the truth, for error messages."""

    @classmethod
    def of(cls, truth: Truth | Observations) -> Truth:
        """Return the truth itself, or annotations as a truth without poses."""
        return truth if isinstance(truth, Truth) else cls(truth)


def read_truth(
    path: str | Path,
    video: str | Path | None = None,
    size_px: tuple[int, int] | None = None,
    untracked: Untracked = "video",
) -> Truth:
    """Read the truth from a file of annotations or from the folder of a simulated scene.

    Args:
        path: a file of annotations, as for `read_observations`; or the folder of a simulated scene, which holds the
            annotations as ``truth.json``, the exact poses as the result folder ``truth/`` and the behaviours in
            ``scene.json``.
        video: as for `read_observations`.
        size_px: as for `read_observations`.
        untracked: as for `read_observations`.

    Returns:
        The truth; without poses, model and behaviours for a file, and without behaviours for a folder without
        ``scene.json``.

    Raises:
        InputError: the file does not exist, the folder holds no truth, or a file cannot be read.
    """
    path = Path(path)
    if not os.path.isdir(path):  # noqa: PTH112  (Path.is_dir raises for names that are too long)
        return Truth(read_observations(path, video, size_px, untracked), source=path)
    if not (path / TRUTH).is_file():
        remedy = "give a COCO file of annotations, or the folder of a simulated scene"
        raise InputError(path, f"is a folder without {TRUTH}", remedy)
    if not (path / TRUE_POSES).is_dir():
        remedy = f"give {path / TRUTH} to compare in the image alone"
        raise InputError(path, f"holds no true poses (a folder {TRUE_POSES}/)", remedy)
    return Truth(read_coco(path / TRUTH), *load_solution(path / TRUE_POSES), read_behaviours(path), path)


def read_behaviours(path: str | Path) -> dict[int, list[tuple[int, str]]] | None:
    """Read the behaviours of the birds of a simulated scene.

    Args:
        path: as for `read_truth`.

    Returns:
        As `Truth.behaviours`; None for a COCO file and for a folder without ``scene.json``.

    Raises:
        InputError: ``scene.json`` cannot be read.
    """
    path = Path(path)
    if not (path / MARKER).is_file():
        return None
    behaviours = {}
    for track, entries in read_json(path / MARKER)["behaviour"].entries():
        pairs = [(entry["from_frame"].integer(0), entry["behaviour"].text()) for entry in entries]
        starts = [start for start, _ in pairs]
        number = track.isascii() and track.isdecimal() and len(track) < 19 and str(int(track)) == track
        if not number or starts[:1] != [0] or starts != sorted(set(starts)):
            entries.fail("must be the behaviours of a track id, with from_frame increasing from 0")
        behaviours[int(track)] = pairs
    return behaviours
