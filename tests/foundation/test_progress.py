"""Progress in a log file and on a terminal, also of several tasks at once; notes with a state."""

import io
from contextlib import ExitStack
from types import SimpleNamespace

import pytest
from rich.console import Console

from jaxfit.foundation import progress


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test moves."""
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: clock.now))
    return clock


def test_a_log_receives_a_line_now_and_then(clock, capsys):
    with progress.terminal("Tracking [1]", 200) as report_progress:
        for _ in range(100):
            clock.now += 1
            report_progress(1, "3 birds")
        assert capsys.readouterr().err.splitlines() == [
            "Tracking [1]: 15 %, 0:00:30 + 0:02:50, 3 birds",
            "Tracking [1]: 30 %, 0:01:00 + 0:02:20, 3 birds",
            "Tracking [1]: 45 %, 0:01:30 + 0:01:50, 3 birds",
        ]
        report_progress(100, "5 birds")
    assert capsys.readouterr().err.splitlines() == ["Tracking [1]: 100 %, 0:01:40, 5 birds"]


def test_a_slow_start_is_not_the_speed_of_the_work(clock, capsys):
    """Programs compile before the first step: 60 seconds here, and one second for each step after it."""
    with progress.terminal("Training", 200) as report_progress:
        for seconds in (60, *[1] * 30):
            clock.now += seconds
            report_progress(1, "")
        lines = capsys.readouterr().err.splitlines()
        assert lines == ["Training: 0 %, 0:01:00", "Training: 16 %, 0:01:30 + 0:02:49"]


def test_work_of_unknown_length_shows_the_elapsed_time_only(clock, capsys):
    with progress.terminal("Tracking", None) as report_progress:
        clock.now += 30
        report_progress(7, "7 frames")
    assert capsys.readouterr().err.splitlines() == ["Tracking: 0:00:30, 7 frames"] * 2
    with progress.terminal("Checking the video", 0):
        pass
    assert capsys.readouterr().err == "Checking the video: 100 %, 0:00:00\n"


def test_a_failure_prints_no_last_line(clock, capsys):
    with pytest.raises(KeyError), progress.terminal("Tracking", 2):
        raise KeyError
    assert capsys.readouterr().err == ""


def test_notes_end_with_the_state():
    notes, state = [], iter(("1 MB", "2 MB"))

    class Task:
        def __init__(self, *_):
            pass

        def __enter__(self):
            return lambda done, note: notes.append((done, note))

        def __exit__(self, *_):
            pass

    with progress.annotated(Task, lambda: next(state))("Tracking", 3) as report_progress:
        report_progress(1, "3 birds")
        report_progress(2, "")
    assert notes == [(1, "3 birds, 1 MB"), (2, "2 MB")]


def test_open_tasks_share_their_lines(clock, capsys):
    """A task may end after a task that was opened earlier."""
    with ExitStack() as later, progress.terminal("Tracking", 100) as report_frames:
        clock.now += 10
        report_windows = later.enter_context(progress.terminal("Fitting", None))  # it ends after `Tracking`
        report_windows(3, "2 windows fitted")
        clock.now += 20
        report_frames(25, "25 frames, 3 birds now")
        assert capsys.readouterr().err.splitlines() == [
            "Tracking: 25 %, 0:00:30, 25 frames, 3 birds now",
            "Fitting: 0:00:20, 2 windows fitted",
        ]
        clock.now += 29
        report_windows(3, "4 windows fitted")
        assert capsys.readouterr().err == ""
        report_frames(75, "100 frames, 2 birds now")
    assert capsys.readouterr().err.splitlines() == [
        "Tracking: 100 %, 0:00:59, 100 frames, 2 birds now",
        "Fitting: 0:00:49, 4 windows fitted",
    ]


def test_open_tasks_share_one_display_on_a_terminal(monkeypatch):
    screen = io.StringIO()
    monkeypatch.setattr(
        progress, "Console", lambda **_: Console(file=screen, force_terminal=True, width=120, color_system=None)
    )
    for _ in range(2):  # a second display begins when the first has ended
        with ExitStack() as later, progress.terminal("Tracking", 100) as report_frames:
            report_windows = later.enter_context(progress.terminal("Fitting", None))
            report_frames(50, "50 frames, 3 birds now")
            report_windows(1, "2 windows fitted")
        first, second, end = screen.getvalue().splitlines()[-3:]
        assert "Tracking " in first
        assert " 50 % " in first
        assert first.rstrip().endswith("50 frames, 3 birds now")
        assert "Fitting " in second
        assert "%" not in second
        assert second.rstrip().endswith("2 windows fitted")
        assert "ing" not in end
