"""Comparison of the masks of meshes with annotated masks.

A mesh is drawn into a patch of the image that is as large as the mesh, many meshes in one call. Annotated masks stay
runs of pixels: sums over the drawn columns count the pixels that a run shares with a mesh.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, cast

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxfit.data.formats.rle import ColumnRuns, foreground_runs
from jaxfit.data.neighbours import FrameMasks
from jaxfit.data.observations import Observations
from jaxfit.data.posed_meshes import PosedBirds
from jaxfit.data.solution import Solution
from jaxfit.model.bird import Bird
from jaxfit.progress import ProgressTask
from jaxfit.raster.zbuffer import hard_mask

__all__ = ["MaskComparison", "compare_masks"]

_FRAMES = 64
"""Frames that are compared at once."""
_PIXELS = 8_000_000
"""Most pixels that are drawn at once, where one image has fewer."""
_PATCH_PX = 32
"""Sides of patches are multiples, so that many meshes have patches of the same size."""


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
            if not len(cells):
                continue
            true_cells = np.stack([at[0][cells[:, 0], 0], at[1][cells[:, 1]]], axis=-1)
            sizes_px = np.array([seen.image_size(n, t) for n, t in true_cells.tolist()])
            true = _true_masks(seen, frames, true_cells)
            index = tuple(cells.T)
            true_side[index] = true.side_px
            for some, drawn in _draw(_pose(posed, cells, first), faces, sizes_px):
                own = tuple(cells[some].T)
                predicted_side[own] = drawn.side_px
                iou[own] = _iou(drawn, some, true, frames, true_cells)
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


class _Drawn(NamedTuple):
    """The masks of B meshes, each in a patch of its image."""

    corner_px: Int[np.ndarray, "B 2"]
    """x, y of the first pixel of the patch."""
    box_px: Int[np.ndarray, "B 4"]
    """x, y, width and height of the tight box in the image; width and height 0 for an empty mask."""
    sums: Int[np.ndarray, "B H+1 W"]
    """Number of the mask's pixels above each row, in each column of the patch."""

    @property
    def side_px(self) -> Float[np.ndarray, "B"]:
        """Longer side of the tight box; NaN for an empty mask."""
        longest = self.box_px[:, 2:].max(-1)
        return np.where(longest > 0, longest, np.nan)

    def shared(self, runs: ColumnRuns) -> Int[np.ndarray, "B"]:
        """Return the number of pixels that each mesh shares with the mask of the same position."""
        height, width = self.sums.shape[1] - 1, self.sums.shape[2]
        column = runs.column - self.corner_px[runs.mask, 0]
        inside = (column >= 0) & (column < width)
        mesh, column = runs.mask[inside], column[inside]
        top, bottom = (np.clip(rows[inside] - self.corner_px[mesh, 1], 0, height) for rows in (runs.top, runs.bottom))
        counts = self.sums[mesh, bottom, column].astype(np.int64) - self.sums[mesh, top, column]
        return np.bincount(mesh, counts, len(self.sums)).astype(np.int64)


def _draw(
    vertices: Float[np.ndarray, "D V 3"], faces: np.ndarray, sizes_px: Int[np.ndarray, "D 2"]
) -> Iterator[tuple[Int[np.ndarray, "B"], _Drawn]]:
    """Draw meshes into patches of their images. Yield the positions of some meshes, and their masks.

    The corner of a patch is a whole number of pixels and not beyond the mesh, so the shifted vertices are exact and
    the mask is that of the whole image.
    """
    finite = np.isfinite(vertices[..., :2])
    low = np.where(finite, vertices[..., :2], np.inf).min(1)
    high = np.where(finite, vertices[..., :2], -np.inf).max(1)
    low, high = np.clip(np.floor(low), 0, sizes_px), np.clip(np.ceil(high), 0, sizes_px)
    corner = low.astype(np.int64)
    patch = np.maximum(-(-(high - low).astype(np.int64) // _PATCH_PX), 1) * _PATCH_PX
    for width, height in np.unique(patch, axis=0).tolist():
        same = np.flatnonzero((patch == [width, height]).all(1))
        count = max(_PIXELS // (width * height), 1)
        for some in (same[i : i + count] for i in range(0, len(same), count)):
            moved = vertices[some].copy()
            moved[..., :2] -= corner[some, None].astype(np.float32)
            room = sizes_px[some] - corner[some]  # the patch may reach beyond the image
            mask = hard_mask(moved, faces, width, height)
            mask &= (np.arange(height) < room[:, 1:])[:, :, None] & (np.arange(width) < room[:, :1])[:, None]
            sums = np.zeros((len(some), height + 1, width), np.uint16)
            np.cumsum(mask, axis=1, dtype=np.uint16, out=sums[:, 1:])
            spans = [_span(mask.any(axis)) for axis in (1, 2)]
            firsts, lengths = (np.stack([span[i] for span in spans], axis=-1) for i in (0, 1))
            yield some, _Drawn(corner[some], np.concatenate([firsts + corner[some], lengths], axis=-1), sums)


def _span(there: Bool[np.ndarray, "B L"]) -> tuple[Int[np.ndarray, "B"], Int[np.ndarray, "B"]]:
    """Return the first True of each row, and the length up to the last True; 0 and 0 without any."""
    first, after = there.argmax(1), there.shape[1] - there[:, ::-1].argmax(1)
    return first, np.where(there.any(1), after - first, 0)


def _iou(
    drawn: _Drawn,
    some: Int[np.ndarray, "B"],
    true: _TrueMasks,
    frames: FrameMasks,
    cells: Int[np.ndarray, "D 2"],
) -> Float[np.ndarray, "B"]:
    """Return the IoU of some meshes; NaN without an annotated mask, or where both masks are empty.

    With the mesh P, the true mask T and the other birds O, the mask of the mesh is P ∩ (T ∪ ¬O).
    """
    from pycocotools import mask as coco_mask

    empty = {"size": [1, 1], "counts": b"1"}
    owns, covers = [], {}  # T, and T ∪ O where birds are near
    for b, (box_px, i) in enumerate(zip(drawn.box_px, some.tolist(), strict=True)):
        own = true.masks[i]
        others = [] if own is None or true.whole[i] else frames.others(int(cells[i, 0]), int(cells[i, 1]), box_px)
        owns.append(empty if own is None else own)
        if others:
            covers[b] = coco_mask.merge(cast(Any, [own, *others]))
    runs = foreground_runs(owns)
    area = np.bincount(runs.mask, runs.bottom - runs.top, len(some)).astype(np.int64)
    both, visible = drawn.shared(runs), drawn.sums[:, -1].sum(-1, dtype=np.int64)
    if covers:
        hidden = np.array(list(covers))
        runs = foreground_runs(list(covers.values()))
        covered = drawn.shared(runs._replace(mask=hidden[runs.mask]))
        visible[hidden] += (both - covered)[hidden]
    union = visible + area - both
    known = np.array([true.masks[i] is not None for i in some.tolist()])
    return np.where(known & (union > 0), both / np.maximum(union, 1), np.nan)
