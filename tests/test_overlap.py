"""Signals made ahead of the disk: in order, so many and no more, and whatever goes wrong comes out."""

import threading
import time

import pytest

from cgid.scene.output.generation import ahead


@pytest.mark.parametrize("most", [1, 5])
def test_no_more_are_made_than_asked(most):
    made, enough = [], threading.Event()

    def items():
        for item in range(50):
            made.append(item)
            if len(made) == 3 + most:
                enough.set()
            yield item

    coming = ahead(items(), most)
    assert [next(coming) for _ in range(3)] == [0, 1, 2]
    assert enough.wait(60)  # though nobody asks for them
    time.sleep(0.05)
    assert len(made) == 3 + most
    coming.close()


def test_they_are_made_while_the_others_are_used():
    first_used = threading.Event()

    def items():
        yield 0
        assert first_used.wait(60)
        yield 1

    for item in ahead(items(), 1):
        if item == 0:
            first_used.set()


def test_what_breaks_comes_out_where_it_is_asked_for():
    def items():
        yield 1
        raise ValueError("broken")

    coming = ahead(items(), 5)
    assert next(coming) == 1
    with pytest.raises(ValueError, match="broken"):
        next(coming)


def test_nothing_runs_on_when_it_is_left():
    before = set(threading.enumerate())
    made = []
    coming = ahead((made.append(item) or item for item in range(10**9)), 3)
    next(coming)
    coming.close()
    assert set(threading.enumerate()) <= before
    so_far = len(made)
    time.sleep(0.02)
    assert len(made) == so_far <= 5
