"""Sums for every bird, and how sure the figures are that come of them: intervals over birds, paired ratios."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import bootstrap

__all__ = ["BirdSums", "Interval", "Ratio", "paired_ratio"]

LEVEL = 0.95
"""Share of the resampled figures that an interval holds."""
RESAMPLES = 2000
ROOTS = ("me_p", "me_v")
"""Metrics that are the root of a mean square; all others are means."""


class Interval(NamedTuple):
    """Where a metric lies; NaN twice for fewer than two birds."""

    low: float
    high: float


class Ratio(NamedTuple):
    """How results of the same birds compare in one metric."""

    value: float
    """Over the birds that all of them measure; NaN where there is none."""
    low: float
    """Interval over birds; NaN for fewer than two."""
    high: float
    birds: int
    """How many all of them measure."""


@dataclass(frozen=True)
class BirdSums:
    """What every bird adds to every metric: all that its figures, their intervals and ratios are made of.

    metric = f(Σ_birds numerator / Σ_birds count),  f = √ for ``me_p`` and ``me_v``, whose numerators are squares

    so that a bird weighs as much as is seen of it, whichever birds are taken together.
    """

    birds: tuple[str, ...]
    """Names of the N birds."""
    numerators: dict[str, tuple[float, ...]]
    """Metric → N sums."""
    counts: dict[str, tuple[int, ...]]
    """Metric → over how many samples each is: images, keypoints, pairs of frames, …; 0 for a bird that has none."""

    @classmethod
    def of(
        cls,
        birds: Sequence[Any],
        samples: Mapping[str, Float[np.ndarray, "N T _"]],
        where: Bool[np.ndarray, "N T"] | None = None,
    ) -> BirdSums:
        """Sums over samples.

        Args:
            birds: N names or numbers.
            samples: metric → what each bird, frame and point adds; NaN where it does not count.
            where: the birds and frames to take; None for all.
        """
        numerators, counts = {}, {}
        for metric, values in samples.items():
            kept = values if where is None else np.where(where[..., None], values, np.nan)
            numerators[metric] = tuple(np.nansum(kept, (1, 2)).tolist())
            counts[metric] = tuple(np.isfinite(kept).sum((1, 2)).tolist())
        return cls(tuple(str(bird) for bird in birds), numerators, counts)

    @classmethod
    def joined(cls, parts: Mapping[str, BirdSums]) -> BirdSums:
        """The birds of several results as one flock, each named ``result/bird``: more birds, surer figures.

        Raises:
            ValueError: results with different metrics.
        """
        metrics = next(iter(parts.values())).counts.keys()
        for name, part in parts.items():
            if part.counts.keys() != metrics:
                raise ValueError(f"parts must have one set of metrics; {name} has {', '.join(part.counts)}")
        return cls(
            tuple(f"{name}/{bird}" for name, part in parts.items() for bird in part.birds),
            {m: tuple(value for part in parts.values() for value in part.numerators[m]) for m in metrics},
            {m: tuple(value for part in parts.values() for value in part.counts[m]) for m in metrics},
        )

    def value(self, metric: str) -> float:
        """One metric over all birds; NaN where nothing counts."""
        birds = self.measured(metric)
        return float(_figure(metric)(*self._sums(metric, birds))) if birds else math.nan

    def values(self) -> dict[str, float]:
        """Every metric over all birds."""
        return {metric: self.value(metric) for metric in self.counts}

    def interval(self, metric: str, seed: int = 0) -> Interval:
        """Where the metric lies for birds like these: 95 % percentile interval of 2,000 resamples.

        Whole birds are drawn with replacement, since the frames of one bird resemble each other, and the metric is
        computed anew from their sums. Birds of which nothing counts are left out first.

        The percentiles rather than BCa: for pooled RMS errors of log-normal birds both cover the truth equally often,
        and BCa is undefined where all birds are equal. Few birds make any bootstrap too sure of itself: in that
        trial 95 % intervals covered the truth in some 72 % of cases for 4 birds, 85 % for 7, 89 % for 14.

        Args:
            metric: name.
            seed: of the draw.

        Source: Efron and Tibshirani 1993, *An Introduction to the Bootstrap*, chapters 8 and 13.
        """
        return _percentiles(_figure(metric), self._sums(metric, self.measured(metric)), seed)

    def intervals(self) -> dict[str, Interval]:
        """The interval of every metric."""
        return {metric: self.interval(metric) for metric in self.counts}

    def measured(self, metric: str) -> list[str]:
        """Names of the birds that add something to a metric.

        Raises:
            ValueError: no such metric.
        """
        if metric not in self.counts:
            raise ValueError(f"metric must be one of {', '.join(self.counts)}, not {metric}")
        return [bird for bird, count in zip(self.birds, self.counts[metric], strict=True) if count]

    def _sums(self, metric: str, birds: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        at = [self.birds.index(bird) for bird in birds]
        return np.array(self.numerators[metric], float)[at], np.array(self.counts[metric], float)[at]


def paired_ratio(pairs: Sequence[tuple[BirdSums, BirdSums]], metric: str, seed: int = 0) -> Ratio:
    """metric(a) / metric(b), the geometric mean over pairs of results (a, b) of the same birds.

    The same birds are drawn for all results, so that what makes a bird hard in all of them cancels; otherwise as
    ``BirdSums.interval``. Only birds that all measure are taken, by name.

    Args:
        pairs: sums of the results; one pair or more.
        metric: name.
        seed: of the draw.

    Returns:
        The ratio, its interval and the number of birds; with fewer than two the interval is NaN.

    Raises:
        ValueError: no such metric.
    """
    results = [result for pair in pairs for result in pair]
    in_all = set.intersection(*(set(result.measured(metric)) for result in results))
    birds = [bird for bird in results[0].measured(metric) if bird in in_all]
    sums = tuple(each for result in results for each in result._sums(metric, birds))
    figure = _figure(metric)

    def ratio(*sums: Any, axis: int = -1) -> Any:
        with np.errstate(divide="ignore", invalid="ignore"):
            of = [np.log(figure(n, count, axis)) for n, count in zip(sums[::2], sums[1::2], strict=True)]
            return np.exp(sum(a - b for a, b in zip(of[::2], of[1::2], strict=True)) / len(pairs))

    value = float(ratio(*sums)) if birds else math.nan
    return Ratio(value, *_percentiles(ratio, sums, seed), len(birds))


def _figure(metric: str) -> Callable[..., Any]:
    """The metric as a function of numerators and counts along an axis of birds."""

    def figure(numerator: Any, count: Any, axis: int = -1) -> Any:
        mean = numerator.sum(axis) / count.sum(axis)
        return np.sqrt(mean) if metric in ROOTS else mean

    return figure


def _percentiles(figure: Callable[..., Any], sums: tuple[np.ndarray, ...], seed: int) -> Interval:
    if len(sums[0]) < 2:
        return Interval(math.nan, math.nan)
    found = bootstrap(
        sums,
        figure,
        paired=True,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(float(found.low), float(found.high))
