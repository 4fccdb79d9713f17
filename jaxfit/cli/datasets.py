"""Commands that convert published data sets to observations."""

from __future__ import annotations

import argparse

from jaxfit.cli.tables import counted, show, show_facts
from jaxfit.progress import terminal

__all__ = ["murre"]


def murre(options: argparse.Namespace) -> None:
    """Convert common_murre_temporal to a COCO file and print how the layout was interpreted."""
    from jaxfit.data.formats.coco import write_coco
    from jaxfit.data.formats.common_murre import LICENSE, read_common_murre
    from jaxfit.model.anatomy import MURRE_KEYPOINTS
    from jaxfit.storage.files import check_new_file, check_writable

    check_new_file(options.out, options.overwrite)
    check_writable(options.out)
    chosen = {"none": None, "murre": MURRE_KEYPOINTS}
    names = chosen[options.keypoints] if options.keypoints in chosen else options.keypoints.split(",")
    observations, readings = read_common_murre(options.folder, names, terminal)
    interpretation = "; ".join(f"{question}: {answer}" for question, answer in readings.items())
    info = {
        "description": f"common_murre_temporal; its layout is inferred, not published. {interpretation}",
        "license": LICENSE,
    }
    write_coco(observations, options.out, info)
    show("The layout of this data set is inferred, not published:")
    show_facts(readings)
    tracks, frames = counted(observations.num_tracks, "track"), counted(len(observations.frame_index), "frame")
    show(f"{tracks}, {frames} → {options.out} (licence {LICENSE}: no commercial use; the video itself is not read)")
