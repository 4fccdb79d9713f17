"""The command that suggests frames to label."""

from __future__ import annotations

import argparse
from collections import Counter

from jaxfit.cli.tables import counted, right_aligned, show
from jaxfit.progress import terminal

__all__ = ["suggest_frames"]


def suggest_frames(options: argparse.Namespace) -> None:
    """Choose frames for labelling, and write their pictures and pre-filled labels."""
    from jaxfit.cli.perception import reconstruct_config
    from jaxfit.labelling.suggest import suggest

    config = reconstruct_config(options).track
    done = suggest(
        options.video,
        options.out,
        options.count,
        options.result,
        config,
        overwrite=options.overwrite,
        empty=options.empty,
        progress=terminal,
    )
    table = right_aligned("frame", "time", "birds", "reason", "score")
    table.columns[3].justify = "left"
    for frame in done.frames:
        time = "–" if frame.time_s is None else f"{frame.time_s:.2f} s"
        table.add_row(str(frame.frame_index), time, str(frame.birds), frame.reason, f"{frame.score:.2f}")
    table.caption = (
        "reason: the strongest signal of uncertainty, or variety for a frame that mainly differs from the others; "
        "score: mean rank of all signals among the examined frames, from 0 to 1"
    )
    show(table)
    reasons = ", ".join(f"{reason} {number}" for reason, number in Counter(f.reason for f in done.frames).most_common())
    birds = counted(int(done.observations.present.sum()), "bird")
    show(f"{counted(len(done.frames), 'frame')} with {birds} ({reasons}) → {options.out}")
    show(f"{options.out / 'README.txt'} says how to correct the labels and how to read them again")
