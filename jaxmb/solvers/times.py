"""How often results can be differentiated by times."""

import jax

NO_THIRD_DERIVATIVES = (
    "A third derivative by times of a run (`t0`, `t1`, saved times, times of `jumps`) was asked for; only first and "
    "second ones exist. First ones are in closed form: velocities and `Trajectory.accelerations`."
)


@jax.custom_jvp
def twice_differentiable(time):
    """A time, whose third derivatives raise a `ValueError`."""
    return time


# The slope of a number is 1, the slope of the slope is 0 and has no derivative. (Both are functions of the number, so
# they are batched if it is.)
@jax.custom_jvp
def _slope(x):
    return 1.0 + _curvature(x)


@jax.custom_jvp
def _curvature(x):
    return 0.0 * x


@twice_differentiable.defjvp
def _number_jvp(primals, tangents):
    return primals[0], tangents[0] * _slope(primals[0])


@_slope.defjvp
def _slope_jvp(primals, tangents):
    return _slope(primals[0]), tangents[0] * _curvature(primals[0])


@_curvature.defjvp
def _curvature_jvp(primals, tangents):
    raise ValueError(NO_THIRD_DERIVATIVES)
