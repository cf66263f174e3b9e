"""The list of seeded faults is of the package as it is; `seeded_faults.py` tries which tests notice them."""

import itertools

from fault_switch import PACKAGE
from faults import FAULTS


def test_each_seeded_fault_has_code_that_occurs_once():
    texts = {file: (PACKAGE / file).read_text() for file in {fault.file for fault in FAULTS}}
    for fault in FAULTS:
        assert texts[fault.file].count(fault.code) == 1, f"{fault}: its code occurs not once"
        assert fault.wrong != fault.code and fault.wrong.count("\n") == fault.code.count("\n"), fault
    assert len(set(FAULTS)) == len(FAULTS)


def test_code_with_seeded_faults_compiles():
    for file, faults in itertools.groupby(sorted(FAULTS), key=lambda fault: fault.file):
        text = together = (PACKAGE / file).read_text()
        for fault in faults:
            if together.count(fault.code) == 1:
                together = together.replace(fault.code, fault.wrong)
            else:
                compile(text.replace(fault.code, fault.wrong), f"{fault}", "exec", dont_inherit=True)
        compile(together, file, "exec", dont_inherit=True)
