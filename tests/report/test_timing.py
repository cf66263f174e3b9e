"""Run times of several programs, taken in turns."""

import time

from jaxmb.report.timing import interleaved


def test_interleaved_takes_turns():
    calls = []

    def run(k):
        calls.append(k)
        time.sleep(0.002 * k)

    short, long = interleaved([lambda: run(1), lambda: run(2)], 3)
    assert calls == [1, 2] * 4
    assert len(short) == len(long) == 3 and min(long) > min(short)
