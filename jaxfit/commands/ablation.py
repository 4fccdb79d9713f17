"""Sweep configs, and see what each change is worth."""

from __future__ import annotations

import argparse
import time
from importlib.util import find_spec

from jaxfit.errors import InputError
from jaxfit.formats.coco import read_coco
from jaxfit.model.files import find_bird
from jaxfit.progress import terminal
from jaxfit.tables import counted, show

__all__ = ["ablate"]


def ablate(options: argparse.Namespace) -> None:
    if not all(find_spec(package) for package in ("matplotlib", "tabulate")):
        raise InputError(
            "ablate", "needs matplotlib and tabulate, which are not installed", 'pip install "jaxfit[report]"'
        )
    from jaxfit.ablation.claims import judge
    from jaxfit.ablation.grid import load_grid
    from jaxfit.ablation.measure import check_shared, measure_grid
    from jaxfit.ablation.report import FILES, write_report
    from jaxfit.ablation.runs import claim_folder, fit_grid
    from jaxfit.ablation.table import CAPTION, claims_table, results_table
    from jaxfit.evaluation.truth import read_truth
    from jaxfit.fitting.prepare import Preparation

    began = time.perf_counter()
    grid = load_grid(options.grid)
    bird = find_bird(options.model)
    observations = read_coco(options.observations)
    if options.match != "overlap":
        check_shared(observations, read_truth(options.truth)[0], options.truth)
    prepared = Preparation(observations, bird, None, options.observations)
    inputs = {"observations": options.observations, "truth": options.truth}
    claim_folder(options.out, grid.runs, inputs, bird)
    fitted = fit_grid(prepared, bird, grid.runs, options.out, terminal)
    results = measure_grid(grid.runs, options.out, options.truth, options.match, terminal)
    verdicts = judge(grid.claims, results)
    write_report(results, verdicts, options.out, inputs, bird.name)
    show(results_table(results, "simple"))
    show(CAPTION)
    if verdicts:
        show("\n" + claims_table(verdicts, "simple"))
    before = len(grid.runs) - fitted
    held = f", {before} held already" if before else ""
    show(f"\n{counted(fitted, 'run')} fitted in {(time.perf_counter() - began) / 60:.1f} min{held}. Look at")
    for name, what in FILES.items():
        show(f"  {options.out / name}: {what}")
