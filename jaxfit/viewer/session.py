"""What the page changes: the edits of the tracks, the fit after them, and the frames marked for labelling."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from threading import Lock, Thread
from typing import Any

from jaxfit.data.formats.coco import write_coco
from jaxfit.data.observations import Observations
from jaxfit.foundation.errors import InputError
from jaxfit.foundation.files import write_whole
from jaxfit.foundation.progress import ReportProgress
from jaxfit.foundation.reading import read_text
from jaxfit.review.correct import correct_tracks, read_tracks
from jaxfit.review.edits import Edit, apply_edits, edits_text, parse_edit, read_edits
from jaxfit.review.points import Point
from jaxfit.review.suggest import suggest_marked


@dataclass
class Work:
    """A fit, or the writing of frames, that runs in a thread."""

    kind: str
    """`refit` or `mark`."""
    task: str = ""
    share: float = 0.0
    """Finished share of the present task."""
    out: str = ""
    """The folder, when the work is done."""
    problem: str = ""
    """Why the work failed."""
    done: bool = False
    started: float = field(default_factory=time.monotonic)

    def entries(self) -> dict[str, Any]:
        """Return what the page shows."""
        seconds = time.monotonic() - self.started
        names = "kind", "task", "share", "out", "problem", "done"
        return {name: getattr(self, name) for name in names} | {"seconds": round(seconds, 1)}

    @contextmanager
    def progress(self, name: str, total: float | None) -> Iterator[ReportProgress]:
        """Report the progress of a task (`jaxfit.foundation.progress.ProgressTask`)."""
        self.task, self.share, finished = name, 0.0, 0.0

        def report(done: float, note: str) -> None:
            nonlocal finished
            finished += done
            self.share = finished / total if total else 0.0

        yield report


class EditsChangedError(InputError):
    """The file of edits differs from the list that the page shows."""


class Session:
    """The corrections of one result.

    Args:
        folder: the result.
        edits_path: file of the edits, which the page reads at its start and writes after every change.
        observations: the observations of the fit, for a result of `jaxfit fit`.
        video: the film, which pictures of marked frames come from.

    Raises:
        InputError: the file of the edits cannot be read.
    """

    def __init__(self, folder: Path, edits_path: Path, observations: Path | None, video: Path | None):
        self.folder, self.edits_path, self.observations, self.video = folder, edits_path, observations, video
        self.labels_path = edits_path.with_name(f"{edits_path.name}.labels.json")
        self.edits: list[Edit | Point] = read_edits(edits_path) if edits_path.exists() else []
        self.work: Work | None = None
        self._lock = Lock()

    def set_edits(self, texts: list[str], known: list[str]) -> None:
        """Replace the edits, and write their file, whose comments stay.

        Args:
            texts: the new edits.
            known: the edits that the page showed before.

        Raises:
            EditsChangedError: another page, another viewer or a person has changed the edits.
            InputError: a text is no edit, or the file cannot be read or written.
        """
        edits = [parse_edit(text, "edit of the page") for text in texts]
        with self._lock:
            self._check_known(known)
            self._write_labels(edits)
            before = read_text(self.edits_path, "corrections") if self.edits_path.exists() else ""
            write_whole(self.edits_path, edits_text(edits, before).encode())
            self.edits = edits

    @cached_property
    def _detected(self) -> Observations:
        return read_tracks(self.folder, self.observations).observations

    def _write_labels(self, edits: list[Edit | Point]) -> None:
        """Write the keypoints of the person as labels, which `reconstruct --labels` and `train` read."""
        if any(isinstance(edit, Point) for edit in edits):
            labels = apply_edits(self._detected, edits, self.folder, only_labels=True)
            write_coco(labels.select(frames=(labels.confidence > 0).any((0, 2))), self.labels_path)
        else:
            self.labels_path.unlink(missing_ok=True)

    def _check_known(self, known: list[str]) -> None:
        self.edits = read_edits(self.edits_path) if self.edits_path.exists() else []
        if [str(edit) for edit in self.edits] != known:
            problem = "were changed by another page, another viewer or by hand: nothing was written"
            raise EditsChangedError(self.edits_path, problem, "the list is now the one of the file; correct again")

    def refit(self, finish: Callable[[Path], None], known: list[str]) -> Work:
        """Start `jaxfit tracks` with the edits, and write the new result beside the result.

        Args:
            finish: is called with the new result, before the work is done.
            known: the edits that the page shows.

        Raises:
            EditsChangedError: as of `set_edits`.
            InputError: there is no edit, or other work is running.
        """
        with self._lock:
            self._check_known(known)
            edits = list(self.edits)
        if not edits:
            raise InputError("corrections", "are empty, so nothing changes", "swap, cut, join, delete or exclude first")

        def run(work: Work) -> Path:
            out = free_name(self.folder, "corrected")
            correct_tracks(self.folder, out, edits, self.observations, progress=work.progress)
            finish(out)
            return out

        return self._start("refit", run)

    def mark(self, frames: list[int]) -> Work:
        """Write pictures and labels of marked frames, as `jaxfit suggest` writes them, beside the result.

        Raises:
            InputError: there is no frame or no film, or other work is running.
        """
        if not frames:
            raise InputError("frames to label", "are not marked", "mark a frame first")
        if self.video is None:
            raise InputError(self.folder, "is shown without its film, which has the pictures", "give --video")
        video = self.video

        def run(work: Work) -> Path:
            out = free_name(self.folder, "frames")
            suggest_marked(video, out, sorted(set(frames)), self.observations or self.folder, progress=work.progress)
            return out

        return self._start("mark", run)

    def _start(self, kind: str, run: Callable[[Work], Path]) -> Work:
        with self._lock:
            if self.work is not None and not self.work.done:
                raise InputError("this result", "is still being worked on", "wait until the work is done")
            work = self.work = Work(kind)

        def guarded() -> None:
            try:
                work.out = str(run(work))
            except InputError as error:
                work.problem = str(error)
            except Exception as error:  # the page has to learn of every failure
                work.problem = f"{type(error).__name__}: {error}"
            work.done = True

        Thread(target=guarded, name=f"jaxfit {kind}", daemon=True).start()
        return work


def free_name(folder: Path, word: str) -> Path:
    """Return a name beside a folder that nothing has: `result-corrected`, `result-corrected-2`, and so on."""
    folder = folder.resolve()
    names = (folder.with_name(f"{folder.name}-{word}{'' if n == 1 else f'-{n}'}") for n in range(1, 10_000))
    return next(name for name in names if not name.exists())
