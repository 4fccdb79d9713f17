"""Comparison of the masks of meshes with annotated masks, which stay runs of pixels."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.formats.rle import foreground_runs
from jaxfit.data.observations import FrameMasks, Observations
from jaxfit.data.projection import PosedBirds
from jaxfit.data.solution import Solution
from jaxfit.foundation.progress import ProgressTask
from jaxfit.model.bird import Bird
from jaxfit.raster.zbuffer import mask_overlap

_FRAMES = 64
"""Frames that are posed at once."""
_MESHES = 1000
"""Meshes that are compared at once, which bounds the memory."""


class MaskComparison(NamedTuple):
    """NaN where nothing is measured."""

    iou: Float[np.ndarray, "N T"]
    """Of the mask of the mesh and the annotated mask."""
    true_side_px: Float[np.ndarray, "N T"]
    """Longer side of the annotated mask, or of the annotated box where there is no mask."""
    predicted_side_px: Float[np.ndarray, "N T"]
    """Longer side of the mask of the mesh."""


def compare_masks(
    solution: Solution,
    bird: Bird,
    seen: Observations,
    measured: Bool[np.ndarray, "N T"],
    at: tuple[np.ndarray, np.ndarray],
    progress: ProgressTask,
) -> MaskComparison:
    """Draw the mask of every measured mesh and compare the mask with the annotation.

    Pixels of other birds' masks do not count where the whole mask of the bird is not known.

    Args:
        solution: the result, N tracks over T frames.
        bird: the model of the result.
        seen: the annotations.
        measured: the birds and frames that are compared.
        at: positions of the tracks and frames of the result in the annotations, as `match` returns them.
        progress: shows the progress and the number of poses per second.
    """
    iou, true_side, predicted_side = np.full((3, *measured.shape), np.nan)
    posed, frames = PosedBirds(solution, bird), FrameMasks(seen)
    faces, start, done = np.asarray(posed.faces), time.perf_counter(), 0
    with progress("Measuring", int(measured.sum())) as report_progress:
        for first in range(0, measured.shape[1], _FRAMES):
            cells = np.argwhere(measured[:, first : first + _FRAMES]) + np.array([0, first])
            for some in (cells[i : i + _MESHES] for i in range(0, len(cells), _MESHES)):
                true_cells = np.stack([at[0][some[:, 0], 0], at[1][some[:, 1]]], axis=-1)
                sizes_px = np.array([seen.image_size(n, t) for n, t in true_cells.tolist()])
                true, vertices = _true_masks(seen, frames, true_cells), _pose(posed, some, first)
                index = tuple(some.T)
                true_side[index] = true.side_px
                iou[index], predicted_side[index] = _compare(vertices, faces, sizes_px, true, frames, true_cells)
                done += len(some)
                report_progress(len(some), f"{done / (time.perf_counter() - start):,.0f} poses/s")
    return MaskComparison(iou, true_side, predicted_side)


class _TrueMasks(NamedTuple):
    """The annotated masks of D birds."""

    masks: list[Mapping[str, Any] | None]
    """Whole mask of each bird where it is known, else its visible mask; None without a mask."""
    side_px: Float[np.ndarray, "D"]
    whole: list[bool]
    """Whether the whole mask is known."""


def _true_masks(seen: Observations, frames: FrameMasks, cells: Int[np.ndarray, "D 2"]) -> _TrueMasks:
    from pycocotools import mask as coco_mask

    pairs = [(n, t) for n, t in cells.tolist()]
    amodal = [seen.amodal_masks.get(cell) for cell in pairs]
    masks = [frames.mask(*cell) if rle is None else rle for cell, rle in zip(pairs, amodal, strict=True)]
    side = seen.box_px[tuple(cells.T)][:, 2:].max(-1).astype(np.float64)
    known = [rle for rle in masks if rle is not None]
    if known:
        longest = np.asarray(coco_mask.toBbox(cast(Any, known)))[:, 2:].max(-1)
        side[[rle is not None for rle in masks]] = np.where(longest > 0, longest, np.nan)
    return _TrueMasks(masks, side, [rle is not None for rle in amodal])


def _pose(posed: PosedBirds, cells: Int[np.ndarray, "D 2"], first: int) -> Float[np.ndarray, "D V 3"]:
    """Return the vertices of some birds and frames; the frames lie within `_FRAMES` frames from `first`."""
    last = posed.solution.valid.shape[1]
    frames = slice(max(min(first, last - _FRAMES), 0), min(first + _FRAMES, last))  # one length, one compiled program
    vertices = [
        posed.vertices_screen_window(n, frames)[cells[cells[:, 0] == n, 1] - frames.start]
        for n in np.unique(cells[:, 0]).tolist()
    ]
    return np.concatenate(vertices)


def _compare(
    vertices: Float[np.ndarray, "D V 3"],
    faces: np.ndarray,
    sizes_px: Int[np.ndarray, "D 2"],
    true: _TrueMasks,
    frames: FrameMasks,
    cells: Int[np.ndarray, "D 2"],
) -> tuple[Float[np.ndarray, "D"], Float[np.ndarray, "D"]]:
    """Return the IoU of meshes, and the longer sides of their masks.

    With the mesh P, the true mask T and the other birds O, the mask of the mesh is P ∩ (T ∪ ¬O). The IoU is NaN without
    T, or where both masks are empty; the side is NaN for an empty P.
    """
    from pycocotools import mask as coco_mask

    x, y = vertices[..., 0], vertices[..., 1]  # numpy is slow for the minimum of both together
    low, high = (np.stack([f.reduce(x, axis=1), f.reduce(y, axis=1)], axis=-1) for f in (np.fmin, np.fmax))
    low, high = np.clip(low, 0, sizes_px), np.clip(high, 0, sizes_px)
    box_px = np.concatenate([low, high - low], axis=-1)
    own = {d: rle for d, rle in enumerate(true.masks) if rle is not None}  # T
    covers = {}  # T ∪ O where birds are near
    for d, rle in own.items():
        others = [] if true.whole[d] else frames.others(int(cells[d, 0]), int(cells[d, 1]), box_px[d])
        if others:
            covers[d] = coco_mask.merge(cast(Any, [rle, *others]))
    mesh, known, near = np.array([*own, *covers], np.int64), [*own], [*covers]
    runs = foreground_runs([*own.values(), *covers.values()])
    drawn = mask_overlap(vertices, faces, sizes_px, mesh[runs.mask], runs.pixels)
    shared = np.bincount(runs.mask, drawn.shared_px, len(mesh))
    both, area = np.full((2, len(vertices)), np.nan)
    both[known], area[known] = shared[: len(own)], runs.areas[: len(own)]
    visible = drawn.area_px.astype(np.float64)
    visible[near] += both[near] - shared[len(own) :]
    union = visible + area - both
    side = drawn.box_px[:, 2:].max(-1).astype(np.float64)
    return np.where(union > 0, both / np.maximum(union, 1), np.nan), np.where(side > 0, side, np.nan)
