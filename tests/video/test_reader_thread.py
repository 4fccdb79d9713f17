"""The thread that decodes ahead: the thread ends with the reading, on errors and on interrupts."""

import collections
import gc
import signal
import threading

import pytest
from support.films import encode, reader_threads

from jaxfit.foundation.errors import InputError
from jaxfit.video.reader import ahead, read_frames

COUNT = 3
"""Number of items that wait."""


def test_the_thread_ends_with_the_reading(tmp_path):
    path = encode(tmp_path / "b_frames.mp4", count=40)

    def stop_at(index, error=None):
        for frame in read_frames(path):
            if frame.index == index:
                assert len(reader_threads()) <= 1
                if error is not None:
                    raise error
                break

    stop_at(3)
    assert not reader_threads()
    with pytest.raises(ZeroDivisionError):
        stop_at(3, ZeroDivisionError())
    gc.collect()
    assert not reader_threads()
    reader = read_frames(path)
    for _ in range(2):  # it can be read again
        assert len(list(reader)) == 40
    assert not reader_threads()


def test_an_interrupt():
    main, ended = threading.main_thread(), []
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it

    def source(stopped):
        try:
            for i in range(10**6):
                if i == 10:
                    signal.pthread_kill(main.ident, signal.SIGINT)
                yield i
        finally:
            ended.append(True)

    try:
        with pytest.raises(KeyboardInterrupt):
            collections.deque(ahead(source, COUNT), maxlen=1)
    finally:
        signal.signal(signal.SIGINT, before)
    gc.collect()
    assert ended
    assert not reader_threads()


def test_the_thread_decodes_a_few_frames_ahead_and_raises_its_error():
    made, taken, largest = 0, 0, 0

    def source(stopped):
        nonlocal made, largest
        for i in range(200):
            made += 1
            largest = max(largest, made - taken)
            yield i
        raise InputError("a", "broken")

    def take():
        nonlocal taken
        for i in ahead(source, COUNT):
            assert i == taken
            taken += 1

    with pytest.raises(InputError, match="a: broken"):
        take()
    assert taken == 200
    assert largest <= COUNT + 2  # one that the caller holds, one that waits in the thread
    assert not reader_threads()
