"""Fit real birds and show them: five species of photographs from the reference data."""

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from jaxfit import cli
from jaxfit.config import config_to_yaml, load_config
from jaxfit.evaluation.evaluate import evaluate
from jaxfit.fitting.fit import fit
from jaxfit.fitting.solution import save_solution
from jaxfit.fitting.summary import summarise
from jaxfit.formats.coco import read_coco
from jaxfit.progress import terminal
from jaxfit.reference_data import reference_bird, reference_folder
from jaxfit.view.sheet import contact_sheet

OUT = Path("demo")
ABSENT = """\
The demo fits photographs of birds that are not part of jaxfit. Set JAXFIT_REFERENCE to the folder that holds
models/aves and cub, and run it again. (A built-in bird will make this unnecessary.)"""


def main() -> int:
    """Fit all species by the shipped config `photo`; leave results and contact sheets in `demo/`."""
    reference, bird = reference_folder(), reference_bird()
    console = Console()
    if reference is None or bird is None or not (reference / "cub").is_dir():
        console.print(ABSENT)
        return 0
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    cli.use_cache()
    config = load_config("photo")
    table = Table("species", "birds", "PCK@0.05", "PCK@0.10", "IoU", "seconds", title="without a starting point")
    for column in table.columns[1:]:
        column.justify = "right"
    for path in sorted((reference / "cub").glob("*.json")):
        observations = read_coco(path)
        began = time.perf_counter()
        solution = fit(observations, bird, config, progress=terminal, source=path)
        seconds = time.perf_counter() - began
        overall = evaluate(solution, bird, observations).overall
        folder = OUT / path.stem
        summary = summarise(solution, bird, {"fit": seconds}) | {"metrics": overall}
        save_solution(solution, bird, config_to_yaml(config), summary, folder, overwrite=True)
        contact_sheet(solution, bird, observations, folder / "birds.png")
        figures = [f"{overall[name]:.3f}" for name in ("pck@0.05", "pck@0.10", "iou")]
        table.add_row(path.stem, str(observations.num_tracks), *figures, f"{seconds:.0f}")
    console.print(table)
    console.print(f"results and a contact sheet (birds.png) for each species → {OUT.resolve()}", soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
