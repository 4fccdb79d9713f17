"""Sweep configs, and see what each change is worth."""

from __future__ import annotations

import argparse
import time

from jaxfit.cli.tables import counted, show
from jaxfit.extras import require_extra
from jaxfit.model.files import find_bird
from jaxfit.progress import terminal

__all__ = ["ablate"]


def ablate(options: argparse.Namespace) -> None:
    require_extra("report", "ablate")
    from jaxfit.ablation.ablate import ablate
    from jaxfit.ablation.report import FILES
    from jaxfit.ablation.table import CAPTION, claims_table, results_table

    began = time.perf_counter()
    done = ablate(
        options.observations,
        options.truth,
        options.out,
        options.grid,
        find_bird(options.model),
        options.match,
        terminal,
    )
    show(results_table(done.results, "simple"))
    show(CAPTION)
    if done.verdicts:
        show("\n" + claims_table(done.verdicts, "simple"))
    before = len(done.results) - done.fitted
    held = f", {before} held already" if before else ""
    show(f"\n{counted(done.fitted, 'run')} fitted in {(time.perf_counter() - began) / 60:.1f} min{held}. Look at")
    for name, what in FILES.items():
        show(f"  {options.out / name}: {what}")
