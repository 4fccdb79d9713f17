"""Which birds are not seen from above, from eight frames of each track.

A search over all orientations is slower, and chooses the sequence of a window among many wrong orientations: it is for
the birds for which the search from above fails. So up to `FRAMES` frames of a track, spread over it, are fitted one by
one with the first stage of the config, from the best orientation seen from above and from the best of all orientations.
Both are fits of one model, so their objectives can be compared whatever the number of candidates. A frame counts for
the start with the lower objective L if

- the two fits end at orientations that differ by more than `MIN_ANGLE_DEG`, and
- the other start is less likely by more than `LIKELIHOOD_RATIO`, with noise as large as the fit shows:

      (L′ − L)/φ > log 20,   φ = 2L/n,

  with n the number of coordinates of the keypoints. The ratio has no unit, and wrong scales of a config cancel.

All orientations are searched where this start has at least `MIN_LEAD` frames more than the start from above (one, for a
track of one frame): a single frame may have wrong keypoints.

Source: McCullagh and Nelder 1989, *Generalized Linear Models* (φ, the dispersion of a quasi-likelihood). The rule is
ours.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy
from jaxtyping import Bool, Int

from jaxfit.config.fit import FitConfig
from jaxfit.fitting.hypotheses import LIKELIHOOD_RATIO, MIN_ANGLE_DEG
from jaxfit.fitting.solve import FitModel, needs_mask
from jaxfit.fitting.tasks import FitTask, fit_task
from jaxfit.fitting.windows import Windows
from jaxfit.objective.registry import find_terms

FRAMES = 8
"""Largest number of frames of a track that are fitted one by one."""
MIN_LEAD = 2


def single_frame_config(config: FitConfig) -> FitConfig:
    """Return a config that fits single frames with the first stage of another, without terms that compare masks."""
    stage = config.stages[0]
    terms = tuple(name for name, term in find_terms(stage.terms).items() if not term.compares_masks)
    used = {name: value for name, value in config.terms.items() if name in terms}
    first = replace(stage, terms=terms or stage.terms, share_body=False, keep_best=False)
    return replace(config, window=1, overlap=0, stages=(first,), terms=used, error_bars=False, learn_weights=())


def seen_from_the_side(windows: Windows, config: FitConfig, model: FitModel) -> Bool[np.ndarray, "W"]:
    """Return the windows of the tracks for which all orientations must be searched.

    Args:
        windows: all windows of the tracks.
        config: the config; a first stage that only compares masks gives no track.
        model: the model of the fit.
    """
    used = single_frame_config(config)
    if any(map(needs_mask, used.stages)):
        return np.zeros(len(windows), bool)
    w, t = _spread_frames(windows)
    frames = _frames_of(windows, w, t)
    starts = (replace(config.initialise, method=method, hypotheses=1) for method in ("viewing_axis", "so3"))
    configs = [replace(used, initialise=start) for start in starts]
    fitted = fit_task(model, FitTask(configs, [frames, frames], [(r, i) for r in (0, 1) for i in range(len(w))]))
    runs = fitted[: len(w)], fitted[len(w) :]
    loss = np.array([[np.inf if each.failure else sum(each.loss.values()) for each in run] for run in runs])
    above, around = (
        scipy.spatial.transform.Rotation.from_rotvec([np.nan_to_num(each.pose.global_orient[0]) for each in run])
        for run in runs
    )
    differ = np.rad2deg((above.inv() * around).magnitude()) > MIN_ANGLE_DEG
    coordinates = 2 * (frames.confidence > 0).sum((1, 2))
    lower, higher = np.minimum(loss.min(0), np.finfo(float).max), loss.max(0)
    sure = (higher - lower) * coordinates > 2 * lower * np.log(LIKELIHOOD_RATIO)
    lead = np.where(differ & sure, np.where(loss[0] > loss[1], 1, -1), 0)
    track = windows.track[w]
    side = [n for n in np.unique(track) if lead[track == n].sum() >= min(MIN_LEAD, (track == n).sum())]
    return np.isin(windows.track, side)


def _spread_frames(windows: Windows) -> tuple[Int[np.ndarray, "F"], Int[np.ndarray, "F"]]:
    """Return window and position of some frames of each track with the bird, spread over the track."""
    rows, columns = np.nonzero(windows.present)
    track, frame = windows.track[rows], windows.frame[rows, columns]
    chosen: list[int] = []
    for n in np.unique(track):
        own = np.flatnonzero(track == n)
        own = own[np.unique(frame[own], return_index=True)[1]]  # a frame that two windows share counts once
        chosen += own[np.unique(np.linspace(0, len(own) - 1, FRAMES).round().astype(int))].tolist()
    return rows[chosen], columns[chosen]


def _frames_of(windows: Windows, w: Int[np.ndarray, "F"], t: Int[np.ndarray, "F"]) -> Windows:
    """Return windows of one frame each, without masks."""
    alone = {
        name: getattr(windows, name)[w, t][:, None]
        for name in ("frame", "present", "crop", "keypoints_px", "confidence")
    }
    return replace(windows[w], **alone, has_mask=np.zeros((len(w), 1), bool))
