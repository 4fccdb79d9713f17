"""Progress in a log file, where stderr is no terminal; notes with a state."""

from types import SimpleNamespace

import pytest

from jaxfit import progress


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
