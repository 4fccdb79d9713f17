"""`ablate`: a grid of fits."""

from __future__ import annotations

import argparse
import time

from jaxfit.cli.tables import show
from jaxfit.foundation.errors import counted
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.progress import terminal
from jaxfit.model.files import find_bird


def ablate(options: argparse.Namespace) -> None:
    """Fit and measure every run of a grid, and print the metrics and the verdicts on claims."""
    require_extra("report", "ablate")
    from jaxfit.evaluation.ablation.ablate import ablate
    from jaxfit.evaluation.ablation.report import FILES
    from jaxfit.evaluation.ablation.table import CAPTION, claims_table, results_table
    from jaxfit.foundation.workers import open_cluster

    start = time.perf_counter()
    bird = find_bird(options.model)
    with open_cluster(options.workers, options.scheduler) as cluster:
        done = ablate(
            options.observations,
            options.truth,
            options.out,
            options.grid,
            bird,
            options.match,
            terminal,
            cluster=cluster,
        )
    show(results_table(done.results, "simple"))
    show(CAPTION)
    if done.verdicts:
        show("\n" + claims_table(done.verdicts, "simple"))
    earlier = len(done.results) - done.fitted
    reused = f", {counted(earlier, 'earlier run')} reused" if earlier else ""
    show(f"\n{counted(done.fitted, 'run')} fitted in {(time.perf_counter() - start) / 60:.1f} min{reused}. Files:")
    for name, text in FILES.items():
        show(f"  {options.out / name}: {text}")
