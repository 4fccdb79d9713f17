"""Durations of the parts of a task."""

from types import SimpleNamespace

import pytest

from jaxfit.foundation import progress as module
from jaxfit.foundation.progress import Clock


@pytest.fixture
def now(monkeypatch):
    now = SimpleNamespace(s=0.0)
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: now.s))
    return now


def test_nested_parts_count_once(now):
    clock = Clock()
    for _ in range(2):
        with clock("track"):
            now.s += 1
            with clock("fit"):
                now.s += 10
                with clock("store"):
                    now.s += 100
            with clock("fit"):
                now.s += 20
            now.s += 2
        now.s += 1000
    assert list(clock.seconds.items()) == [("track", 6), ("fit", 60), ("store", 200)]


def test_a_part_that_fails_is_counted(now):
    clock = Clock()

    def fail():
        with clock("track"):
            now.s += 1
            with clock("fit"):
                now.s += 10
                raise KeyError

    with pytest.raises(KeyError):
        fail()
    assert clock.seconds == {"track": 1, "fit": 10}


def test_items_count_the_time_to_get_them(now):
    def numbers():
        for number in range(3):
            now.s += 1
            yield number

    clock = Clock()
    for _ in clock.each("read", numbers()):
        with clock("use"):
            now.s += 10
    assert clock.seconds == {"read": 3, "use": 30}
