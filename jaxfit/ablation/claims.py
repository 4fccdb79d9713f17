"""Verdicts on the claims of a grid: pairs of runs compared over the same birds."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jaxfit.ablation.grid import Run, hashable
from jaxfit.ablation.measure import CLAIMED, Result
from jaxfit.config.grid import ClaimConfig
from jaxfit.evaluation.bootstrap import Ratio, paired_ratio

__all__ = ["Verdict", "judge", "pairs_of"]


@dataclass(frozen=True)
class Verdict:
    """The verdict on one claim in one metric."""

    claim: ClaimConfig
    metric: str
    pairs: int
    """Number of pairs of runs that differ only in the keys of the claim."""
    agree: int
    """Number of pairs in which the better run of the claim has the lower error."""
    ratio: Ratio
    """Error of the better over the worse run, as the geometric mean over pairs; below 1 where the claim is right."""

    @property
    def holds(self) -> str:
        """The verdict: `holds`, `does not hold`, or `not decided` where the interval over birds contains 1.

        A claim of harmlessness holds unless the interval lies above 1.
        """
        if self.ratio.high < 1:
            return "holds"
        if self.ratio.low > 1:
            return "does not hold"
        if self.claim.harmless and self.ratio.low <= 1 <= self.ratio.high:
            return "holds: no harm shown"
        return "not decided"


def judge(claims: Sequence[ClaimConfig], results: Sequence[Result]) -> list[Verdict]:
    """Return the verdict on each claim in each metric; claims without a pair of runs are skipped."""
    verdicts = []
    sums = {result.run.name: result.evaluation.sums for result in results}
    runs = [result.run for result in results]
    for claim in claims:
        pairs = [(sums[better.name], sums[worse.name]) for better, worse in pairs_of(claim, runs)]
        for metric in CLAIMED if pairs else ():
            agree = sum(better.value(metric) < worse.value(metric) for better, worse in pairs)
            verdicts.append(Verdict(claim, metric, len(pairs), agree, paired_ratio(pairs, metric)))
    return verdicts


def pairs_of(claim: ClaimConfig, runs: Sequence[Run]) -> list[tuple[Run, Run]]:
    """Return the pairs (better, worse) of a claim: runs with equal values of all keys that the claim does not name."""
    named = {*claim.better, *claim.worse}
    worse_runs: dict[Hashable, list[Run]] = {}

    def rest(run: Run) -> Hashable:
        return hashable({path: level for path, level in run.levels.items() if path not in named})

    for run in runs:
        if _has(run, claim.worse):
            worse_runs.setdefault(rest(run), []).append(run)
    return [
        (better, worse) for better in runs if _has(better, claim.better) for worse in worse_runs.get(rest(better), ())
    ]


def _has(run: Run, levels: Mapping[str, Any]) -> bool:
    return all(run.levels[path] == level for path, level in levels.items())
