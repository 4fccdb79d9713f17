"""`view`, `label`: film, birds and timeline in a page of the browser."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxfit.cli.results import frame_range
from jaxfit.cli.tables import show
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.extras import require_extra
from jaxfit.foundation.progress import terminal

if TYPE_CHECKING:
    from jaxfit.viewer.server import Viewer


def view(options: argparse.Namespace) -> None:
    """Serve the page until Ctrl+C, or save the page."""
    from jaxfit.data.formats.recognise import read_observations
    from jaxfit.data.result_folder import check_is_of_video, read_summary
    from jaxfit.export.result import open_result
    from jaxfit.video.reader import probe_video
    from jaxfit.view.overlay import check_belongs
    from jaxfit.viewer.saved import save_page
    from jaxfit.viewer.shown import Shown

    frames, video = frame_range(options.frames), options.video
    observations = None if options.observations is None else read_observations(options.observations)

    def opened(folder: Path, seen=None) -> Shown:
        return Shown(folder, open_result(folder, None, frames, options.fps), seen, options.camera)

    results = [opened(folder, observations if n == 0 else None) for n, folder in enumerate(options.results)]
    if video is None and results[0].exported.video is not None and results[0].exported.video.exists():
        video = results[0].exported.video
    if video is None:
        show("without the film: --video shows it beside the birds")
    else:
        for each in results:
            check_is_of_video(
                each.folder, read_summary(each.folder), "leave out --video: the page shows the birds in 3D"
            )
            check_belongs(each.solution, None, video, probe_video(video), options.force)
    if options.save is not None:
        saved = save_page(results, video, options.save, options.overwrite, terminal)
        for what in saved.left_out:
            show(f"left out: {what}")
        show(f"{saved.path} ({saved.bytes / 1e6:.2f} MB): open it in a browser")
        return
    require_extra("view", "jaxfit view", "starlette", "uvicorn")
    from jaxfit.viewer.server import Viewer
    from jaxfit.viewer.session import Session

    session = None
    if len(results) == 1:
        edits = options.edits or options.results[0].resolve().with_name(f"{options.results[0].resolve().name}.edits")
        session = Session(options.results[0], edits, options.observations, video)
    elif options.edits is not None:
        raise InputError("--edits", "corrects one result, and several are given", "give one result")
    _serve(Viewer(results, video, session, opened), options, options.results[0].resolve().parent)


def label(options: argparse.Namespace) -> None:
    """Serve the page of a film without a result until Ctrl+C."""
    require_extra("view", "jaxfit label", "starlette", "uvicorn")
    from jaxfit.model.files import find_bird
    from jaxfit.review.edits import read_edits
    from jaxfit.review.points import Point
    from jaxfit.review.suggest import varied_frames
    from jaxfit.viewer.blank import Blank, LabelSession, labels_edits
    from jaxfit.viewer.server import Viewer

    for name in ("count", "birds"):
        if getattr(options, name) < 1:
            raise InputError(f"--{name}", f"is {getattr(options, name)}", "give 1 or more")
    out = options.out or options.video.resolve().with_name(f"{options.video.resolve().stem}.labels.json")
    edits = labels_edits(out)
    if out.exists() and not edits.exists():
        raise InputError(out, "exists and was not written by `jaxfit label`", "give another --out")
    points = [edit for edit in (read_edits(edits) if edits.exists() else []) if isinstance(edit, Point)]
    frames = np.union1d(varied_frames(options.video, options.count, terminal), [point.frame for point in points])
    birds = max([options.birds, *(point.track for point in points)])
    blank = Blank(options.video, find_bird(options.model), frames.astype(int), birds)
    show(f"labels → {out}")
    _serve(Viewer([blank], options.video, LabelSession(blank, out)), options, out.resolve().parent)


def _serve(viewer: Viewer, options: argparse.Namespace, folder: Path) -> None:
    """Serve a page, and open it in the browser; `folder` gets the page that leads there."""
    from jaxfit.viewer.server import listening, serve

    sock, leading = listening(options.port), []

    def started(address: str) -> None:
        show(f"{address}")
        show("open this address in a browser of this computer; Ctrl+C ends the viewer")
        if has_display() and not options.no_browser:
            leading.append(leading_page(address, folder))
            webbrowser.open(leading[0].as_uri())

    try:
        serve(viewer, sock, started)
    finally:
        for page in leading:
            page.unlink(missing_ok=True)


def leading_page(address: str, folder: Path) -> Path:
    """Write a page that only this user can read, and that leads to an address.

    All users of a computer can read the arguments of a browser, and the address has a secret token. Browsers in a
    sandbox see no temporary folder, so that the page is beside the result where possible.
    """
    text = f'<!DOCTYPE html>\n<meta http-equiv="refresh" content="0; url={address}">\n<a href="{address}">result</a>\n'
    try:
        descriptor, name = tempfile.mkstemp(".html", "jaxfit-view-", folder)
    except OSError:
        descriptor, name = tempfile.mkstemp(".html", "jaxfit-view-")
    with os.fdopen(descriptor, "w") as file:  # has the mode 0600
        file.write(text)
    return Path(name)


def has_display() -> bool:
    """Whether this computer can show a browser."""
    return sys.platform in ("darwin", "win32") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
