"""Bootstrap over birds: metrics from sums per bird, intervals of metrics, and ratios of paired results."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple

import numpy as np
import pydantic
from jaxtyping import Bool, Float
from scipy.stats import bootstrap

LEVEL = 0.95
"""Fraction of the resampled values inside an interval."""
RESAMPLES = 2000
"""Number of resamples."""
ROOTS = ("me_p", "me_v")
"""Metrics that are the root of a mean square; all other metrics are means."""


Number = Annotated[float, pydantic.BeforeValidator(lambda value: math.nan if value is None else value)]
"""A number of a file, in which NaN is null."""


class Interval(NamedTuple):
    """Confidence interval of a metric; NaN for fewer than two birds."""

    low: Number
    high: Number


class Ratio(NamedTuple):
    """Ratio of one metric between results of the same birds."""

    value: float
    """Over the birds that all results measure; NaN without such a bird."""
    low: float
    """Lower end of the interval over birds; NaN for fewer than two birds."""
    high: float
    """Upper end of the interval."""
    birds: int
    """Number of birds that all results measure."""


@dataclass(frozen=True)
class BirdSums:
    """Sums of errors per bird and metric, from which metrics, intervals and ratios are computed.

    metric = f(Σ_birds numerator / Σ_birds count),  f = √ for ``me_p`` and ``me_v``, whose numerators are squares

    so the weight of a bird is the number of its errors, in any selection of birds.
    """

    birds: tuple[str, ...]
    """Names of the N birds."""
    numerators: dict[str, tuple[float, ...]]
    """Metric → N sums of errors."""
    counts: dict[str, tuple[int, ...]]
    """Metric → N numbers of errors in the sums: images, keypoints, pairs of frames, …; 0 for a bird without errors."""

    @classmethod
    def of(
        cls,
        birds: Sequence[Any],
        errors: Mapping[str, Float[np.ndarray, "N T _"]],
        where: Bool[np.ndarray, "N T"] | None = None,
    ) -> BirdSums:
        """Return the sums of errors.

        Args:
            birds: N names or numbers.
            errors: metric → the error of each bird, frame and point (squared for ``ROOTS``); NaN does not count.
            where: the birds and frames that count; None for all.
        """
        numerators, counts = {}, {}
        for metric, values in errors.items():
            kept = values if where is None else np.where(where[..., None], values, np.nan)
            numerators[metric] = tuple(np.nansum(kept, (1, 2)).tolist())
            counts[metric] = tuple(np.isfinite(kept).sum((1, 2)).tolist())
        return cls(tuple(str(bird) for bird in birds), numerators, counts)

    def value(self, metric: str) -> float:
        """Return one metric over all birds; NaN where nothing counts."""
        birds = self.measured(metric)
        return float(_metric_function(metric)(*self.sums_of(metric, birds))) if birds else math.nan

    def values(self) -> dict[str, float]:
        """Return every metric over all birds."""
        return {metric: self.value(metric) for metric in self.counts}

    def interval(self, metric: str, seed: int = 0) -> Interval:
        """Return the 95 % percentile interval of the metric over birds, from 2,000 resamples.

        Whole birds are drawn with replacement, since the errors in the frames of one bird are correlated. The metric
        of a resample is computed from the sums of the drawn birds. Birds without errors are excluded first.

        Percentiles are used instead of BCa: in a trial with pooled RMS errors of log-normal birds, both covered the
        truth equally often, and BCa is undefined where all birds are equal. Intervals of few birds are too narrow: in
        this trial, 95 % intervals covered the truth in about 72 % of cases for 4 birds, 85 % for 7 and 89 % for 14.

        Args:
            metric: name.
            seed: of the random draw.

        Source: Efron and Tibshirani 1993, *An Introduction to the Bootstrap*, chapters 8 and 13.
        """
        return _percentiles(_metric_function(metric), self.sums_of(metric, self.measured(metric)), seed)

    def intervals(self) -> dict[str, Interval]:
        """Return the interval of every metric."""
        return {metric: self.interval(metric) for metric in self.counts}

    def measured(self, metric: str) -> list[str]:
        """Return the names of the birds with errors in a metric.

        Raises:
            ValueError: the metric is unknown.
        """
        if metric not in self.counts:
            raise ValueError(f"metric must be one of {', '.join(self.counts)}, not {metric}")
        return [bird for bird, count in zip(self.birds, self.counts[metric], strict=True) if count]

    def sums_of(self, metric: str, birds: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums of errors of some birds, and the numbers of errors."""
        at = [self.birds.index(bird) for bird in birds]
        return np.array(self.numerators[metric], float)[at], np.array(self.counts[metric], float)[at]


def paired_ratio(pairs: Sequence[tuple[BirdSums, BirdSums]], metric: str, seed: int = 0) -> Ratio:
    """Return metric(a) / metric(b), as the geometric mean over pairs of results (a, b) of the same birds.

    A resample draws the same birds for all results, so the difficulty of a bird, which all results share, cancels;
    otherwise the interval is computed as in ``BirdSums.interval``. Only birds that all results measure count, matched
    by name.

    Args:
        pairs: sums of the results; one pair or more.
        metric: name.
        seed: of the random draw.

    Returns:
        The ratio, its interval and the number of birds; the interval is NaN for fewer than two birds.

    Raises:
        ValueError: the metric is unknown.
    """
    results = [result for pair in pairs for result in pair]
    in_all = set.intersection(*(set(result.measured(metric)) for result in results))
    birds = [bird for bird in results[0].measured(metric) if bird in in_all]
    sums = tuple(values for result in results for values in result.sums_of(metric, birds))
    metric_of = _metric_function(metric)

    def ratio(*sums: Any, axis: int = -1) -> Any:
        with np.errstate(divide="ignore", invalid="ignore"):
            logs = [np.log(metric_of(n, count, axis)) for n, count in zip(sums[::2], sums[1::2], strict=True)]
            return np.exp(sum(a - b for a, b in zip(logs[::2], logs[1::2], strict=True)) / len(pairs))

    value = float(ratio(*sums)) if birds else math.nan
    return Ratio(value, *_percentiles(ratio, sums, seed), len(birds))


def _metric_function(metric: str) -> Callable[..., Any]:
    """Return the metric as a function of the sums and counts along an axis of birds."""

    def metric_of(numerator: Any, count: Any, axis: int = -1) -> Any:
        mean = numerator.sum(axis) / count.sum(axis)
        return np.sqrt(mean) if metric in ROOTS else mean

    return metric_of


def _percentiles(metric_of: Callable[..., Any], sums: tuple[np.ndarray, ...], seed: int) -> Interval:
    """Return the percentile interval of a function of sums, over resamples of birds."""
    if len(sums[0]) < 2:
        return Interval(math.nan, math.nan)
    interval = bootstrap(
        sums,
        metric_of,
        paired=True,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=LEVEL,
        method="percentile",
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return Interval(float(interval.low), float(interval.high))
