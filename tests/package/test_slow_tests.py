"""The slow tests that are run first, and the record of their last runs."""

import sys

import slow

PARTS, STUDIES = slow.TESTS / "parts", slow.TESTS / "studies"


def test_slow_tests_of_a_change_come_first():
    """Tests in the folder of its name, then those that mention what it defines, then those of what imports this."""
    rope = ["jaxmb/parts/rope.py"]
    assert slow.distance(PARTS / "test_rope.py", rope) == 0
    assert slow.distance(STUDIES / "test_loads.py", rope) == 1
    assert slow.distance(STUDIES / "test_loads.py", ["tests/studies/test_loads.py"]) == 0
    assert 1 < slow.distance(STUDIES / "test_loads.py", ["jaxmb/parts/tangents.py"]) < sys.maxsize
    assert slow.distance(PARTS / "test_rope.py", ["jaxmb/report/__init__.py"]) == sys.maxsize


def test_slow_tests_passed_when_they_last_ran():
    assert not [test for test, last in slow.read_record().items() if not last["passed"]]
