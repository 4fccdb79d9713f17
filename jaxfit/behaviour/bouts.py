"""`find_bouts`: bouts of behaviour by the rules of a config; time budgets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import bootstrap

from jaxfit.behaviour.describe import Description, circular_mean
from jaxfit.behaviour.rules import OTHER, BehaviourConfig, BehaviourRule, Range

LEVEL, RESAMPLES = 0.95, 2000
"""Level of the intervals of time budgets, and number of resamples of the bootstrap."""
MIN_BIRDS = 8
"""Fewer birds have no interval."""
_EPSILON_S = 1e-6
NO_POSE = -1
"""State of a bird without a pose."""


class Bout(NamedTuple):
    """One bird that shows one behaviour without interruption."""

    bird: int
    """Position of the track."""
    behaviour: str
    frames: slice
    """Positions of the frames."""
    start_s: float
    stop_s: float
    """End of the last frame."""
    partner: int | None
    """Track of the neighbour, for behaviours with a partner."""
    means: Mapping[str, float]
    """Feature → mean in the bout; of directions, the circular mean."""


@dataclass(frozen=True, eq=False)
class Ethogram:
    """What N birds do in T frames."""

    names: tuple[str, ...]
    """The behaviours of the config that the result can show, and `OTHER`."""
    state: Int[np.ndarray, "N T"]
    """Position in `names`; `NO_POSE` without a pose."""
    bouts: tuple[Bout, ...]
    """In the order of birds and times."""
    time_s: Float[np.ndarray, "T"]
    frame_s: Float[np.ndarray, "T"]
    """Time that each frame stands for: to the next frame, or the usual time around the frame before a gap."""
    missing: Mapping[str, str]
    """Behaviour that the result cannot show → why."""

    def select(self, rows: Int[np.ndarray, "M"], columns: Int[np.ndarray, "L"], description: Description) -> Ethogram:
        """Return the behaviour of M birds in L frames. Bouts are cut at the ends of these frames.

        Args:
            rows: positions of the birds.
            columns: positions of the frames, without a gap.
            description: features of these birds in these frames.
        """
        first, stop = int(columns[0]), int(columns[-1]) + 1
        time_s, frame_s = self.time_s[columns], self.frame_s[columns]
        bouts = []
        for n, row in enumerate(rows.tolist()):
            for each in self.bouts:
                run = slice(max(each.frames.start, first) - first, min(each.frames.stop, stop) - first)
                if each.bird == row and run.start < run.stop:
                    bouts.append(_bout(n, each.behaviour, run, description, frame_s, each.partner is not None))
        return replace(self, state=self.state[rows][:, columns], bouts=tuple(bouts), time_s=time_s, frame_s=frame_s)


class Budget(NamedTuple):
    """The time of one behaviour."""

    track: int | None
    """None: of all birds."""
    behaviour: str
    seconds: float
    """Of the frames with a pose."""
    share: float
    """Share of the time with a pose."""
    bouts: int
    """Number of bouts; 0 for `OTHER`, which is the absence of a behaviour and has no bouts."""
    low: float
    """Lower end of the interval of the share (`LEVEL`, bootstrap over birds); NaN for one bird or too few birds."""
    high: float


def find_bouts(description: Description, config: BehaviourConfig) -> Ethogram:
    """Return the bouts of all birds.

    A bout of a rule is a run of frames in which all conditions of `lasts` hold, with a frame in which all conditions of
    `begins` hold (hysteresis). Interruptions of up to `bridge_s` belong to it, and runs shorter than `least_s` do not
    count. Rules of earlier behaviours take their frames first; what they leave of a bout counts if it has a frame of
    `begins` and lasts `least_s`. For a flight, this includes the frames that its own take-off and landing take.

    Args:
        description: features, with those of the config. Their times are known.
        config: the rules.
    """
    time_s, valid = description.flock.time_s, description.flock.solution.valid
    frame_s = _frame_times(time_s, description.flock.step_s)
    found: dict[str, np.ndarray] = {}
    begins: dict[str, np.ndarray] = {}
    missing: dict[str, str] = {}
    for name, rule in config.behaviours.items():
        needed = [each for part in rule.conditions() for each in part]
        absent = [each for each in needed if each in description.missing]
        if absent:
            missing[name] = f"{absent[0]}: {description.missing[absent[0]]}"
        elif rule.begins:
            begins[name], lasts = (_holds(description, part) for part in rule.conditions())
            found[name] = _kept(_bridged(lasts, time_s, frame_s, rule), begins[name], time_s, frame_s, rule)
    for name, rule in config.behaviours.items():
        target = rule.start_of or rule.end_of
        if target is None:
            continue
        if target in missing:
            missing[name] = missing[target]
        else:
            found[name] = begins[name] = _edges(found[target], valid, time_s, frame_s, rule)
    names = (*(name for name in config.behaviours if name in found), OTHER)
    owner = np.full(valid.shape, len(names) - 1)
    for i, name in enumerate(names[:-1]):
        free = found[name] & (owner == len(names) - 1)
        rules = [config.behaviours[each] for each in names[:-1]]
        edges = [k for k, each in enumerate(rules) if name in (each.start_of, each.end_of)]
        left = free | (found[name] & np.isin(owner, edges))
        owner[free & _kept(left, begins[name], time_s, frame_s, config.behaviours[name])] = i
    bouts = [
        _bout(n, name, run, description, frame_s, config.behaviours[name].partner)
        for i, name in enumerate(names[:-1])
        for n, row in enumerate(owner == i)
        for run in _runs(row, _pauses(time_s, frame_s, config.behaviours[name]))
    ]
    bouts.sort(key=lambda each: (each.bird, each.start_s))
    return Ethogram(names, np.where(valid, owner, NO_POSE), tuple(bouts), time_s, frame_s, missing)


def _frame_times(time_s: Float[np.ndarray, "T"], step_s: Float[np.ndarray, "T"]) -> Float[np.ndarray, "T"]:
    """Return the time that each frame stands for: to the next frame, or the usual time before a gap."""
    usual = np.nan_to_num(step_s)  # 0 for one frame
    to_next = np.append(np.diff(time_s), usual[-1:])
    return np.where(to_next <= 1.5 * usual, to_next, usual)


def _holds(description: Description, conditions: Mapping[str, Range]) -> Bool[np.ndarray, "N T"]:
    """Return where all conditions hold; a value that is not defined holds no condition."""
    flock, features = description.flock, {each.name: each for each in description.features}
    holds = flock.solution.valid.copy()
    for name, (low, high) in conditions.items():
        per_length = flock.model_length if features[name].unit.startswith("length") else 1.0
        is_track = features[name].unit == "id"
        values = description.tracks(name).astype(float) if is_track else description.values[name] / per_length
        with np.errstate(invalid="ignore"):
            holds &= (values > low) & (values < high)
    return holds


def _runs(mask: Bool[np.ndarray, "T"], pause: Bool[np.ndarray, "T-1"] | None = None) -> list[slice]:
    """Return the runs of a mask; a run ends where the video pauses after a frame."""
    part = np.ones(len(mask), int) if pause is None else 1 + np.append(0, np.cumsum(pause))
    bounds = np.flatnonzero(np.diff(np.where(mask, part, 0), prepend=0, append=0)).tolist()
    return [slice(a, b) for a, b in pairwise(bounds) if mask[a]]


def _pauses(time_s: np.ndarray, frame_s: np.ndarray, rule: BehaviourRule) -> Bool[np.ndarray, "T-1"]:
    """Return after which frames the video pauses for longer than a rule bridges."""
    return np.diff(time_s) - frame_s[:-1] > rule.bridge_s + _EPSILON_S


def _bridged(
    mask: Bool[np.ndarray, "N T"], time_s: np.ndarray, frame_s: np.ndarray, rule: BehaviourRule
) -> Bool[np.ndarray, "N T"]:
    """Return the mask with short interruptions filled."""
    filled = mask.copy()
    for n, row in enumerate(mask):
        for before, after in pairwise(_runs(row)):
            last = before.stop - 1
            if time_s[after.start] - time_s[last] - frame_s[last] <= rule.bridge_s + _EPSILON_S:
                filled[n, before.stop : after.start] = True
    return filled


def _kept(
    mask: Bool[np.ndarray, "N T"],
    begins: Bool[np.ndarray, "N T"],
    time_s: np.ndarray,
    frame_s: np.ndarray,
    rule: BehaviourRule,
) -> Bool[np.ndarray, "N T"]:
    """Return the runs that contain a frame of `begins` and last at least `least_s`."""
    kept, pause = np.zeros_like(mask), _pauses(time_s, frame_s, rule)
    for n, row in enumerate(mask):
        for run in _runs(row, pause):
            last = run.stop - 1
            seconds = time_s[last] + frame_s[last] - time_s[run.start]
            kept[n, run] = begins[n, run].any() and seconds >= rule.least_s - _EPSILON_S
    return kept


def _edges(
    mask: Bool[np.ndarray, "N T"],
    valid: Bool[np.ndarray, "N T"],
    time_s: np.ndarray,
    frame_s: np.ndarray,
    rule: BehaviourRule,
) -> Bool[np.ndarray, "N T"]:
    """Return the frames around the starts, or the ends, of runs; the bird is seen on both sides, without a pause."""
    found, T, at_start = np.zeros_like(mask), len(time_s), rule.start_of is not None
    pause = _pauses(time_s, frame_s, rule)
    part = np.append(0, np.cumsum(pause))
    for n, row in enumerate(mask):
        for run in _runs(row, pause):
            edge = run.start if at_start else run.stop
            if edge == 0 or edge == T or pause[edge - 1] or not valid[n, edge - 1 : edge + 1].all():
                continue
            near = (np.abs(time_s - time_s[edge]) <= rule.around_s + _EPSILON_S) & (part == part[edge])
            near[: run.start if not at_start else 0] = False
            near[run.stop if at_start else T :] = False
            found[n] |= near
    return found & valid


def _bout(
    bird: int, name: str, run: slice, description: Description, frame_s: Float[np.ndarray, "T"], partner: bool
) -> Bout:
    """Return a bout with the means of the features, and with the usual neighbour as its partner if it has one."""
    time_s, values, neighbour = description.flock.time_s, description.values, None
    if partner and "neighbour" in values:
        positions = values["neighbour"][bird, run]
        known, counts = np.unique(positions[np.isfinite(positions)], return_counts=True)
        neighbour = int(description.track_id[int(known[counts.argmax()])]) if len(known) else None
    means = {e.name: _mean(values[e.name][bird, run], e.circular) for e in description.features if e.unit != "id"}
    stop_s = float(time_s[run.stop - 1] + frame_s[run.stop - 1])
    return Bout(bird, name, run, float(time_s[run.start]), stop_s, neighbour, means)


def _mean(values: np.ndarray, circular: bool) -> float:
    known = values[np.isfinite(values)].astype(np.float64)
    if not len(known):
        return float("nan")
    return float(circular_mean(known) if circular else known.mean())


def time_budget(ethogram: Ethogram, track_id: Int[np.ndarray, "N"]) -> list[Budget]:
    """Return the time of each behaviour of all birds together, and of each bird.

    The intervals of all birds are percentile intervals of the bootstrap over birds, whose weight is their time with a
    pose. The bootstrap of fewer than `MIN_BIRDS` birds is too narrow, so they have no interval.
    """
    seen = (ethogram.state != NO_POSE) @ ethogram.frame_s
    rows: list[Budget] = []
    for i, name in enumerate(ethogram.names):
        seconds = (ethogram.state == i) @ ethogram.frame_s
        bouts = np.zeros(len(seen), int)
        for each in ethogram.bouts:
            bouts[each.bird] += each.behaviour == name
        low, high = _interval(seconds[seen > 0], seen[seen > 0])
        share = seconds.sum() / seen.sum() if seen.sum() else float("nan")
        rows.append(Budget(None, name, float(seconds.sum()), float(share), int(bouts.sum()), low, high))
        for n, track in enumerate(track_id.tolist()):
            own = seconds[n] / seen[n] if seen[n] else float("nan")
            rows.append(Budget(track, name, float(seconds[n]), float(own), int(bouts[n]), float("nan"), float("nan")))
    return sorted(rows, key=lambda row: (row.track is not None, row.track or 0))


def _interval(seconds: Float[np.ndarray, "N"], seen: Float[np.ndarray, "N"]) -> tuple[float, float]:
    if len(seconds) < MIN_BIRDS or not seconds.any():
        return float("nan"), float("nan")
    with np.errstate(all="ignore"):
        found = bootstrap(
            (seconds, seen),
            lambda a, b, axis: a.sum(axis=axis) / b.sum(axis=axis),
            paired=True,
            n_resamples=RESAMPLES,
            confidence_level=LEVEL,
            method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval
    return float(found.low), float(found.high)
