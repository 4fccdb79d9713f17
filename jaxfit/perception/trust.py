"""The judgement of a video: its signals, their limits, and whether trust is high or low."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, cast

import numpy as np

from jaxfit.data.flags import contradict_masks
from jaxfit.data.observations import Observations

REMEDY = (
    "use another network (--segmenter, --keypoints), label frames of this footage (jaxfit suggest), "
    "or crop the video to the birds"
)
"""What to do when trust is low."""

# The limits lie beyond the values of 13 good clips out of 15 simulated ones (seeds 700 to 714, random cameras of
# `jaxfit.learning.networks.scenes`, 960×640, 12 or 20 consecutive frames at 12 frames/s), in which 78 to 95 % of the
# keypoints are right. The two other clips have 79 and 81 %, a clip from the side (seed 790, 8° below the horizontal)
# has 50 %. The values for distances, short tracks and the number of birds are those of earlier networks.
MAX_FRAME_DISTANCE = 1.0
"""Largest median distance of the frames: 99 % of the training inputs are nearer. The clips have 0.27 to 0.58."""
MAX_BIRD_DISTANCE = 1.0
"""Largest median distance of the birds: 99 % of the training inputs are nearer. The clips have 0.48 to 0.76."""
MIN_SCORE = 0.75
"""Least median score. 12 clips with and without spread wings (seeds 700 to 711) have 0.80 to 0.95, a short clip of four
birds 0.79."""
MIN_CONFIDENCE = 0.75
"""Least median confidence of a bird. The good clips have 0.80 to 0.95, the others 0.65 and 0.72, the clip from the side
0.72."""
MAX_SHORT_SHARE = 0.2
"""Largest share of the detections in short tracks. The good clips have 0 to 0.11, the others 0.05 and 0.16. A clip of
12 frames has more short tracks than a video."""
MAX_COUNT_CHANGE = 0.15
"""Largest change of the number of birds. The good clips have 0 to 0.05, the others 0.07 and 0.10. The limit is higher,
because the number changes more in footage with fewer frames per second."""
MAX_CONTRADICTED_SHARE = 0.1
"""Largest share of birds whose keypoints lie outside their masks. The 12 clips have 0 to 0.03, two scenes of 100 frames
0.02 and 0.05; masks that lack wings give up to 0.21."""
COMPARED_BIRDS = 300
"""Number of birds, evenly spread over the video, whose keypoints are compared with their masks."""


class FootageSignals(NamedTuple):
    """Signals of the tracking of a video; None for a signal that this video or its networks do not give."""

    birds_per_frame: float
    """Mean number of tracked birds in a frame, short tracks included."""
    short_tracks: int = 0
    """Number of tracks that are too short."""
    tracks: int = 0
    """Number of all tracks."""
    short_share: float | None = None
    """Share of the detections that belong to tracks that are too short."""
    count_change: float | None = None
    """Mean change of the number of birds between consecutive frames, divided by `birds_per_frame`."""
    score: float | None = None
    """Median score of the birds; None for a segmenter without statistics, because scores of networks differ."""
    contradicted_share: float | None = None
    """Share of the birds whose keypoints contradict their masks (`jaxfit.data.flags`)."""
    confidence: float | None = None
    """Median over the birds of the mean confidence of a bird's keypoints; None for confidences without a curve."""
    frame_distance: float | None = None
    """Median over the frames of the distance of the segmenter's activations."""
    bird_distance: float | None = None
    """Median over the birds of the distance of the activations of the keypoint network."""


class Trust(NamedTuple):
    """Whether the networks work on a video as they work on simulated footage, and why not."""

    level: str
    """`high` or `low`."""
    reasons: tuple[str, ...]
    """Why trust is low; empty if trust is high."""
    signals: FootageSignals

    def judgement(self) -> str:
        """Return the level and its reasons for the user."""
        if self.level == "high":
            if None in (self.signals.frame_distance, self.signals.bird_distance):
                return "trust is high, but not certain: a network stores no statistics of its training"
            return "trust is high: the networks work on this footage as on simulated footage"
        return f"trust is low: {'; '.join(self.reasons)}"

    def sentence(self) -> str:
        """Return the judgement for the user, and what to do if trust is low."""
        return self.judgement() + ("" if self.level == "high" else f"; {REMEDY}")

    def info(self) -> dict[str, str]:
        """Return the judgement as texts, for the `info` of a COCO file."""
        return {"trust": self.level, "trust_reasons": "; ".join(self.reasons)}


def footage_signals(
    observations: Observations,
    short_tracks: Mapping[int, int],
    distances: Sequence[Sequence[float]] = ((), ()),
    calibrated: bool = False,
) -> FootageSignals:
    """Compute the signals of a video.

    Args:
        observations: all tracks, short tracks included.
        short_tracks: track → number of frames, for the tracks that are too short.
        distances: distances of the segmenter's activations and of the keypoint network's activations.
        calibrated: whether the confidences of the keypoints are calibrated.
    """
    present, scores = observations.present, cast(np.ndarray, observations.score)
    detections = int(present.sum())
    counts = present.sum(0)
    frame_distance, bird_distance = (float(np.median(values)) if len(values) else None for values in distances)
    confidence = observations.confidence.mean(-1)[present] if observations.num_keypoints and calibrated else ()
    is_changing = detections and len(counts) > 1
    return FootageSignals(
        birds_per_frame=float(counts.mean()),
        short_tracks=len(short_tracks),
        tracks=observations.num_tracks,
        short_share=sum(short_tracks.values()) / detections if detections else None,
        count_change=float(np.abs(np.diff(counts)).mean() / counts.mean()) if is_changing else None,
        score=float(np.median(scores[present])) if detections and frame_distance is not None else None,
        contradicted_share=_contradicted_share(observations) if len(confidence) else None,
        confidence=float(np.median(confidence)) if len(confidence) else None,
        frame_distance=frame_distance,
        bird_distance=bird_distance,
    )


def _contradicted_share(observations: Observations) -> float:
    """Return the share of the birds whose keypoints contradict their masks, of up to `COMPARED_BIRDS` birds."""
    cells = np.argwhere(observations.present)
    cells = cells[np.unique(np.linspace(0, len(cells) - 1, COMPARED_BIRDS).astype(int))]
    return float(contradict_masks(observations, cells)[tuple(cells.T)].mean())


def judge(signals: FootageSignals) -> Trust:
    """Judge a video: trust is low if a signal lies beyond its limit, or if there is no bird.

    Args:
        signals: the signals; a signal that is None is not judged.
    """
    reasons = []
    for signal, limit, bound, text, unit in _RULES:
        value = getattr(signals, signal)
        if value is not None and (value > limit if bound == "at most" else value < limit):
            reasons.append(f"{text.format(**signals._asdict())} ({bound} {limit:{unit}} on simulated footage)")
    if not signals.tracks:
        reasons.insert(0, "no bird was tracked")
    return Trust("low" if reasons else "high", tuple(reasons), signals)


_RULES = (
    (
        "frame_distance",
        MAX_FRAME_DISTANCE,
        "at most",
        "the frames differ from the training of the segmenter: distance {frame_distance:.2f}",
        ".2g",
    ),
    (
        "bird_distance",
        MAX_BIRD_DISTANCE,
        "at most",
        "the birds differ from the training of the keypoint network: distance {bird_distance:.2f}",
        ".2g",
    ),
    ("score", MIN_SCORE, "at least", "the scores of the birds are low: median {score:.2f}", ".2g"),
    (
        "contradicted_share",
        MAX_CONTRADICTED_SHARE,
        "at most",
        "{contradicted_share:.0%} of the birds have keypoints outside their masks",
        ".0%",
    ),
    (
        "confidence",
        MIN_CONFIDENCE,
        "at least",
        "the confidences of the keypoints are low: median {confidence:.2f}",
        ".2g",
    ),
    (
        "short_share",
        MAX_SHORT_SHARE,
        "at most",
        "{short_tracks} of {tracks} tracks are too short, and hold {short_share:.0%} of the detections",
        ".0%",
    ),
    (
        "count_change",
        MAX_COUNT_CHANGE,
        "at most",
        "the number of birds changes by {count_change:.0%} from frame to frame",
        ".0%",
    ),
)
"""Signal, limit, kind of limit, the reason that the user reads beyond the limit, and the format of the limit."""
