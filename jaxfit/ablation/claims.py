"""What a grid was to show, and whether it does: runs compared in pairs, over the same birds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from jaxfit.ablation.grid import Run
from jaxfit.ablation.measure import Result
from jaxfit.config.grid import ClaimConfig
from jaxfit.evaluation.bootstrap import Ratio, paired_ratio

__all__ = ["CLAIMED", "Verdict", "judge", "pairs_of"]

CLAIMED = ("me_p", "me_v")
"""Metrics that claims are about; lower is better."""


@dataclass(frozen=True)
class Verdict:
    """One claim in one metric."""

    claim: ClaimConfig
    metric: str
    pairs: int
    """Pairs of runs that differ in nothing but what the claim is about."""
    agree: int
    """How many of them go the claimed way."""
    ratio: Ratio
    """Better over worse: geometric mean over the pairs; below 1 where the claim is right."""

    @property
    def holds(self) -> str:
        """`holds`, `does not hold`, or `not decided` where the interval over birds has 1 inside.

        A claim of harmlessness holds unless harm is shown.
        """
        if self.ratio.high < 1:
            return "holds"
        if self.ratio.low > 1:
            return "does not hold"
        if self.claim.harmless and self.ratio.low <= 1 <= self.ratio.high:
            return "holds: no harm shown"
        return "not decided"


def judge(claims: Sequence[ClaimConfig], results: Sequence[Result]) -> list[Verdict]:
    """Compare what each claim names, in every metric; claims without a pair of runs are left out."""
    verdicts = []
    for claim in claims:
        of_run = {result.run.name: result.evaluation.sums for result in results}
        pairs = [(of_run[a.name], of_run[b.name]) for a, b in pairs_of(claim, [result.run for result in results])]
        for metric in CLAIMED if pairs else ():
            agree = sum(better.value(metric) < worse.value(metric) for better, worse in pairs)
            verdicts.append(Verdict(claim, metric, len(pairs), agree, paired_ratio(pairs, metric)))
    return verdicts


def pairs_of(claim: ClaimConfig, runs: Sequence[Run]) -> list[tuple[Run, Run]]:
    """Runs that should be better, each with those that it is to be compared with."""
    named = {*claim.better, *claim.worse}

    def rest(run: Run) -> dict[str, Any]:
        return {path: level for path, level in run.levels.items() if path not in named}

    return [
        (better, worse)
        for better in runs
        for worse in runs
        if _has(better, claim.better) and _has(worse, claim.worse) and rest(better) == rest(worse)
    ]


def _has(run: Run, levels: Mapping[str, Any]) -> bool:
    return all(run.levels[path] == level for path, level in levels.items())
