"""A fault is switched on in all functions that have its code, and in no other."""

import gc
import importlib
import sys

import fault_switch
import pytest
from fault_switch import Fault

LAWS = '''
import functools

LIMIT = (1.0, 2.0)
SIGN, SIZES = -1.0, {"left": 2.0}
def twice(function):
    @functools.wraps(function)
    def doubled(x):
        return 2 * function(x)
    return doubled
@twice
def spring(x):
    """A law."""
    return -x
class Damper:
    factor = 3.0
    rate: float = 5.0
    def force(self, v):
        return [-self.factor * w for w in v]
    @property
    def size(self):
        return 1 + self.factor
def along(a):
    return lambda x: a + x
LAW = lambda x: x + 1
def force(x, scale=1.0):
    return scale * x
'''
USER = "from .laws import LIMIT, spring\nfrom . import laws\ndef seen(x):\n    return spring(x) + LIMIT[0]\n"


@pytest.fixture
def laws(tmp_path, monkeypatch):
    """Modules of a small package in the place of jaxmb."""
    name = "laws_of_" + "".join(filter(str.isalnum, tmp_path.name))
    package = tmp_path / name
    package.mkdir()
    for file, text in {"__init__.py": "", "laws.py": LAWS, "user.py": USER}.items():
        (package / file).write_text(text)
    monkeypatch.setattr(fault_switch, "PACKAGE", package)
    monkeypatch.syspath_prepend(tmp_path)
    fault_switch.prepare()
    yield sys.modules[f"{name}.laws"]
    for module in [module for module in sys.modules if module.split(".")[0] == name]:
        del sys.modules[module]
    fault_switch._with_marks.cache_clear()


FAULTS = {
    "decorated": ("return -x", "return x", lambda laws, user: user.seen(1.0), -1.0, 3.0),
    "method": ("[-self.factor", "[self.factor", lambda laws, user: laws.Damper().force([1.0]), [-3.0], [3.0]),
    "property": ("1 + self", "2 + self", lambda laws, user: laws.Damper().size, 4.0, 5.0),
    "lambda": ("x + 1", "x - 1", lambda laws, user: laws.LAW(1.0), 2.0, 0.0),
    "closure": ("a + x", "a - x", lambda laws, user: laws.along(1.0)(1.0), 2.0, 0.0),
    "module": ("(1.0, 2.0)", "(7.0, 2.0)", lambda laws, user: user.seen(1.0), -1.0, 5.0),
    "dictionary": ('"left": 2.0', '"left": 4.0', lambda laws, user: laws.SIZES["left"], 2.0, 4.0),
    "class": ("factor = 3.0", "factor = 4.0", lambda laws, user: laws.Damper().size, 4.0, 5.0),
}


@pytest.mark.parametrize("name, notes", [*((name, False) for name in FAULTS), ("decorated", True), ("class", True)])
def test_a_fault_is_switched_on(laws, name, notes):
    code, wrong, value, before, after = FAULTS[name]
    user = importlib.import_module(f"{laws.__package__}.user")
    assert value(laws, user) == before
    (fault_switch.note_functions if notes else fault_switch.switch_on)(Fault("laws.py", code, wrong))
    assert value(laws, user) == after


def test_closures_that_exist_have_the_fault(laws):
    closure = laws.along(1.0)
    fault_switch.switch_on(Fault("laws.py", "a + x", "a - x"))
    assert closure(1.0) == 0.0


@pytest.mark.parametrize("code, wrong", [("rate: float = 5.0", "rate: float = 6.0"), ("scale=1.0", "scale=2.0")])
def test_what_cannot_be_switched_on_is_refused(laws, code, wrong):
    with pytest.raises(ValueError, match="only assignments can be changed"):
        fault_switch.switch_on(Fault("laws.py", code, wrong))


def test_code_that_nothing_has_is_refused(laws):
    del laws.spring, importlib.import_module(f"{laws.__package__}.user").spring
    gc.collect()
    with pytest.raises(ValueError, match="no function that exists has this code"):
        fault_switch.switch_on(Fault("laws.py", "return -x", "return x"))


def test_functions_are_noted_with_and_without_a_fault(laws):
    fault = Fault("laws.py", "a + x", "a - x")
    reached = fault_switch.note_functions(None)
    laws.Damper().force([1.0])
    laws.along(1.0)(2.0)
    assert reached == {"laws.py:Damper.force", "laws.py:along", "laws.py:along.<locals>.<lambda>"}
    assert fault.place() in reached and Fault("laws.py", "return -x", "return x").place() not in reached
