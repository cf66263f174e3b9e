"""Published benchmarks of rigid mechanisms, in the measures of their libraries: those that the scripts of `benchmarks/`
time.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import wheelset_problem as wheelset
from equal_error import Point, seconds_at
from iftomm_problems import CASES, EIGENVALUES, eigenvalue_error
from ivp_test_set import PROBLEMS, relative, scd
from radau5 import motion_of

import jaxmb as mb


@pytest.mark.slow
@pytest.mark.parametrize("number, bound", [("A01", 1e-7), ("A03", 1e-7)])
def test_iftomm_problem_is_solved(number, bound):
    case = CASES[number]
    mechanism, t1 = case.mechanism(), min(float(case.times[-1]), 2.0)
    times = case.times[:: len(case.times) // 50]
    times = np.append(times[times < t1], t1)
    motion = mb.simulate(mechanism.system, mechanism.state, t1=t1, saveat=times, rtol=1e-8, solver=case.solver)
    assert case.error(mechanism, motion) < bound


@pytest.mark.slow
@pytest.mark.parametrize("damping", EIGENVALUES)
def test_iftomm_four_bar_with_a_diagonal_spring_has_its_eigenvalues(damping):
    assert eigenvalue_error(damping)[1] < 2e-10


@pytest.mark.slow
@pytest.mark.parametrize("name, digits", [("fekete", 9.0), ("wheelset", 5.0)])
def test_ivp_test_set_is_solved(name, digits):
    """Its other mechanisms, Andrews's and the car's axis, are those of the library."""
    problem = PROBLEMS[name]()
    system, state = problem.build()
    motion = mb.simulate(system, state, t1=problem.t1, rtol=1e-8)
    end = problem.end(motion)
    assert scd(end, problem.published) > digits and relative(end, problem.exact) < 10.0**-digits


@pytest.mark.slow
def test_wheelset_touches_where_the_source_says():
    q = jnp.asarray(np.append(wheelset.COORDINATES, 0.0))
    for side, known in zip(wheelset.SIDES.values(), wheelset.CONTACTS, strict=True):
        found = wheelset.contact(side, q)
        np.testing.assert_allclose([found.psi, found.xi], known, rtol=0, atol=1e-12)
        # The source keeps rates of the gap at zero.
        rate = jax.grad(lambda q, side=side: wheelset.contact(side, q).gap)(q) @ jnp.asarray(wheelset.RATES)
        assert abs(rate) < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("name, bound", [("andrews", 1e-5), ("car_axis", 1e-4)])
def test_radau5_solves_the_equations_in_the_coordinates_of_the_test_set(name, bound):
    pytest.importorskip("assimulo")
    problem = PROBLEMS[name]()
    run = motion_of(problem.equations)(1e-9)
    assert run.ok and relative(problem.end_of(run), problem.exact) < bound


def test_seconds_at_an_error_are_those_of_the_best_runs_about_it():
    points = [Point(1e-3, 1e-2, 1.0), Point(1e-4, 3e-2, 5.0), Point(1e-5, 1e-4, 4.0), Point(1e-6, 1e-6, 16.0)]
    assert seconds_at(points, 1e-3) == pytest.approx(2.0)
    assert seconds_at(points, 1e-5) == pytest.approx(8.0)
    assert seconds_at(points, 0.5) == 1.0
    assert np.isnan(seconds_at(points, 1e-7))
