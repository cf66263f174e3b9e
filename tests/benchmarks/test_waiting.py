"""The waiting times that the README quotes, and how a process waits for programs that are kept."""

import re
from pathlib import Path

import pytest
from waiting import FIRST_CALLS, first_calls

README = Path(__file__).parents[2] / "README.md"


def test_waiting_times_are_those_that_the_readme_quotes():
    block = re.search(r"tests/benchmarks/waiting.py.*?```text\n(.*?)```", README.read_text(), re.DOTALL)
    names = [line.split(":")[0] for line in block.group(1).splitlines() if ":" in line]
    assert names and all(f'("{name}", ' in FIRST_CALLS for name in names)


@pytest.mark.slow
def test_waiting_is_shorter_in_the_second_process():
    """Without what this process has told JAX of kept programs."""
    times = {name: (float(first), float(second)) for name, first, second in first_calls()[1:]}
    for name in ("four_bar: first value", "four_bar: first gradient"):
        assert times[name][1] < times[name][0]
        # Those that follow compile nothing.
        assert times[name.replace("first", "another")][0] < times[name][1]
