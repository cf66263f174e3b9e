import pytest
import reported_machines


@pytest.fixture(scope="module")
def pendulum():
    return reported_machines.pendulum()
