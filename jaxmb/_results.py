"""Outcomes of a simulation."""

import diffrax

from ._compat import set_message


class RESULTS(diffrax.RESULTS):  # pyright: ignore[reportGeneralTypeIssues]
    """Outcomes of diffrax, and of mechanics. Each text names the next thing to try.

    ```python
    motion = jaxmb.simulate(system, state, t1=1.0, throw=False)
    if motion.result != jaxmb.RESULTS.successful:
        print(jaxmb.RESULTS[motion.result])
    ```
    """

    singular_configuration = (
        "The mechanism came to a singular configuration (toggle, lock-up or bifurcation): the rank of its constraints "
        "falls, and the motion beyond is not determined by them. With `throw=False` the motion up to there is kept."
    )
    newton_failed = (
        "Newton's method found no state on the constraints, however small the step: constraints whose derivatives are "
        "not smooth or that cannot be met, or numbers that are not finite. Where no error estimate shortens the steps, "
        "or where states are interpolated between them, the steps may be too long. With `throw=False` the motion up to "
        "there is kept."
    )
    inconsistent_constraints = (
        "Constraint rows that others implied when the system was compiled are violated along the motion: they "
        "contradict the others. Remove them, or make dimensions and prescribed motions agree. With `throw=False` the "
        "motion up to there is kept."
    )
    too_many_events = (
        "There were more impacts and other events of contacts than `max_events`. With `throw=False` the motion up to "
        "there is kept."
    )
    contacts_undetermined = (
        "Contacts and friction have no solution where bodies came to touch, or slip ended (Painlevé's paradox). A "
        "smaller coefficient of friction, or a compliant contact, has one. With `throw=False` the motion up to there "
        "is kept."
    )
    assembly_failed = (
        "The initial state is not finite or violates the constraints: `jaxmb.assemble` makes it consistent. If it is "
        "from `assemble(..., throw=False)`, the mechanism cannot be assembled with these numbers, and "
        "`jaxmb.assembly_gap` measures how far it is from that."
    )
    invalid_parameters = (
        "A parameter is not finite, or not in the range that its part asks for, or a direction is not a unit vector, "
        "or a design variable is outside its bounds. `jaxmb.with_parameters` with numbers that are not traced names it."
    )
    # The last results, in the order of their introduction, since results are stored by their numbers.
    saved_outside = "A saved time is not between `t0` and `t1`, or not a number, or before the previous saved time."
    input_ended = "An input is a `Series` that is not known for the whole motion, from `t0` to `t1`."
    impacts_backward = "Impacts cannot be undone: with contacts `t1` must be after `t0`."
    friction_undetermined = (
        "The friction of joints has no solution, or more than one: its force changes the reaction that it depends on "
        "too much (Painlevé's paradox). A smaller coefficient, or a compliant contact, has one. With `throw=False` the "
        "motion up to there is kept."
    )
    interrupted = "The run was interrupted by Ctrl-C; the motion up to there is kept."


# The message of diffrax is empty, which says nothing of a good run.
set_message(RESULTS.successful, "successful")
