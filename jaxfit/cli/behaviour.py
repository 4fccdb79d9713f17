"""`describe`: what the birds of a result do."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

import numpy as np

from jaxfit.cli.results import frame_range, track_ids
from jaxfit.cli.tables import right_aligned, show
from jaxfit.foundation.errors import counted
from jaxfit.foundation.progress import terminal

if TYPE_CHECKING:
    from jaxfit.behaviour.result import Described


def describe(options: argparse.Namespace) -> None:
    """Write features, bouts and time budgets of the birds of a result."""
    from jaxfit.behaviour.registry import find_feature
    from jaxfit.behaviour.result import check_outputs, describe_result, write_described
    from jaxfit.behaviour.rules import load_behaviour_config
    from jaxfit.export.result import frame_positions, open_result, track_positions

    check_outputs(options.out, options.overwrite)
    config = load_behaviour_config(options.config)
    features = [find_feature(name) for name in options.feature or []]
    tracks = None if options.tracks is None else track_ids(options.tracks)
    frames = frame_range(options.frames)
    whole = open_result(options.result, fps=options.fps)
    rows = track_positions(whole.solution, tracks, options.result)
    columns = frame_positions(whole.solution, frames, options.result)
    exported = whole.select(rows, columns)
    exported.require_poses()
    # neighbours and movements of the chosen part need the rest of the result
    done = describe_result(options.result, whole, config, features, terminal).select(rows, columns)
    written = write_described(exported, done, options.out, options.overwrite, terminal)
    _show(done)
    for path in written.removed:
        show(f"removed {path}, a file of an earlier run that this result does not have")
    for path in written.files:
        show(f"{path} ({path.stat().st_size / 1e6:.2f} MB)")
    poses = counted(int(exported.solution.valid.sum()), "pose")
    birds = counted(len(exported.solution.track_id), "bird")
    unit = "metres" if done.description.flock.unit == "m" else "body lengths"
    show(f"{counted(len(done.description.features), 'feature')} of {poses} of {birds}; lengths in {unit}")


def _show(done: Described) -> None:
    """Print notes, what is missing, and the time budget of all birds."""
    from jaxfit.behaviour.bouts import LEVEL
    from jaxfit.behaviour.describe import by_reason

    for note in done.notes:
        show(note)
    for what, missing in (("column", done.description.missing), ("behaviour", _missing_behaviours(done))):
        for reason, names in by_reason(missing).items():
            show(f"without {counted(len(names), what)} ({reason}): {', '.join(names)}")
    if done.ethogram is None:
        return
    table = right_aligned(
        "behaviour", "seconds", "share %", f"{100 * LEVEL:.0f} %", "bouts", "median s", title="time of all birds"
    )
    for row in done.budget:
        if row.track is not None or not row.seconds:
            continue
        lengths = [b.stop_s - b.start_s for b in done.ethogram.bouts if b.behaviour == row.behaviour]
        interval = "–" if np.isnan(row.low) else f"{100 * row.low:.0f} to {100 * row.high:.0f}"
        median = f"{np.median(lengths):.2f}" if lengths else "–"
        table.add_row(
            row.behaviour, f"{row.seconds:.1f}", f"{100 * row.share:.1f}", interval, f"{row.bouts or '–'}", median
        )
    show(table)


def _missing_behaviours(done: Described) -> dict[str, str]:
    return {} if done.ethogram is None else dict(done.ethogram.missing)
