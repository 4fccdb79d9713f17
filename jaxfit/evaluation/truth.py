"""What a result is measured against, read from wherever it lies."""

from __future__ import annotations

from pathlib import Path

from jaxfit.data.formats.coco import read_coco
from jaxfit.data.formats.fields import read_json
from jaxfit.data.formats.scene_folder import MARKER, TRUE_POSES, TRUTH
from jaxfit.data.observations import Observations
from jaxfit.data.solution import Solution, load_solution
from jaxfit.errors import InputError
from jaxfit.model.bird import Bird

__all__ = ["read_behaviours", "read_truth"]


def read_truth(path: str | Path) -> tuple[Observations, Solution | None, Bird | None]:
    """Read annotations, and true poses where there are any.

    Args:
        path: a COCO file of annotations, or the folder of a simulated scene, which holds them as
            ``truth.json`` and the true poses as the folder of results ``truth/``.

    Returns:
        The annotations; the true poses and their model, or None twice for a COCO file.

    Raises:
        InputError: no such file, a folder without truth, or files that cannot be read.
    """
    path = Path(path)
    if not path.is_dir():
        return read_coco(path), None, None
    if not (path / TRUTH).is_file():
        remedy = "give a COCO file of annotations, or the folder of a simulated scene"
        raise InputError(path, f"is a folder without {TRUTH}", remedy)
    if not (path / TRUE_POSES).is_dir():
        remedy = f"give {path / TRUTH} to compare in the image alone"
        raise InputError(path, f"holds no true poses (a folder {TRUE_POSES}/)", remedy)
    return read_coco(path / TRUTH), *load_solution(path / TRUE_POSES)


def read_behaviours(path: str | Path) -> dict[int, list[tuple[int, str]]] | None:
    """Read what each bird of a simulated scene does when.

    Args:
        path: as for `read_truth`.

    Returns:
        Track id → from which frame on, and what, in the order of frames and beginning with frame 0; None where
        behaviours are not told: for a COCO file, or a folder without ``scene.json``.

    Raises:
        InputError: a ``scene.json`` that cannot be read.
    """
    path = Path(path)
    if not (path / MARKER).is_file():
        return None
    behaviours = {}
    for track, told in read_json(path / MARKER)["behaviour"].entries():
        acts = [(act["from_frame"].integer(0), act["behaviour"].text()) for act in told]
        starts = [start for start, _ in acts]
        if not track.isdecimal() or starts[:1] != [0] or starts != sorted(set(starts)):
            told.fail("must say for a bird's number from which frame on it does what, in order, from frame 0 on")
        behaviours[int(track)] = acts
    return behaviours
