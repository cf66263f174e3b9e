"""Springs, dampers and motors by tables, against the spline in NumPy and against closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from derivative_checks import central_differences
from scipy.integrate import solve_ivp
from scipy.interpolate import BPoly

import jaxmb as mb
from jaxmb import planar, spatial
from jaxmb.parts import local_spline

MASS, INERTIA = 1.5, 0.4
X, Y = np.array([-0.7, 0.1, 0.4, 1.0, 1.1]), np.array([0.3, -1.0, 0.8, 0.5, 2.0])
value = jax.jit(jax.vmap(local_spline.value, in_axes=(None, None, 0)))


@pytest.mark.slow
def test_derivatives_by_the_points_of_a_table():
    """Forwards, backwards and by differences, inside and beyond the table; of the spline and its integral."""

    def seen(points):
        x, y = points[: X.size], points[X.size :]
        at, functions = jnp.array([-1.0, -0.2, 0.37, 1.05, 1.4]), (local_spline.value, local_spline.integral)
        return jnp.concatenate([jax.vmap(function, (None, None, 0))(x, y, at) for function in functions])

    points, rng = np.concatenate([X, Y]), np.random.default_rng(0)
    weights, along = rng.normal(size=10), rng.normal(size=points.size) * np.abs(points)

    @jax.jit
    def every(x):
        _, pull = jax.vjp(seen, x)
        moved = jax.vmap(seen)(x[None] + 2e-4 * np.outer([1, -1, 2, -2], along))
        return jax.jvp(seen, (x,), (along,))[1], pull(jnp.asarray(weights))[0], moved

    forward, reverse, (near, back, far, beyond) = map(np.asarray, every(points))
    np.testing.assert_allclose(reverse @ along, weights @ forward, rtol=1e-12)
    np.testing.assert_allclose(forward, (8 * (near - back) - (far - beyond)) / 24e-4, rtol=1e-7, atol=1e-7)


def test_the_integral_of_the_spline():
    """Inside and beyond the table; its derivative is the spline, and the spline has two continuous derivatives."""
    at = np.array([-2.0, -0.7, -0.2, 0.1, 0.37, 0.4, 1.05, 1.1, 3.0])
    one = lambda s: local_spline.value(jnp.asarray(X), jnp.asarray(Y), s)
    work = lambda s: local_spline.integral(jnp.asarray(X), jnp.asarray(Y), s)
    single = lambda s: (one(s), jax.grad(one)(s), jax.grad(jax.grad(one))(s), work(s), jax.grad(work)(s))
    # From point to point of the table the spline is a polynomial: by Gauss's rule, up to each place.
    nodes, weights = np.polynomial.legendre.leggauss(5)
    edges = np.sort([np.append(np.clip(X, *sorted((X[0], s))), s) for s in at], axis=1)
    half = 0.5 * np.diff(edges, axis=1)[..., None]
    inner = edges[:, :-1, None] + half * (1 + nodes)
    places = np.concatenate([at, X, X - 1e-9, X + 1e-9, [-1.7, 2.1], inner.ravel()])
    values, slopes, curvatures, integrals, forces = map(np.asarray, jax.jit(jax.vmap(single))(places))
    work_of = np.sum(half * weights * values[26:].reshape(inner.shape), axis=(1, 2))
    expected = np.where(at < X[0], -1.0, 1.0) * work_of
    np.testing.assert_allclose(integrals[:9], expected, rtol=0, atol=1e-11)
    np.testing.assert_allclose(forces, values, rtol=0, atol=1e-13)
    np.testing.assert_allclose(values[9:14], Y, rtol=0, atol=1e-14)
    for rates in (slopes, curvatures):
        np.testing.assert_allclose(rates[14:19], rates[19:24], rtol=0, atol=1e-4)
    np.testing.assert_allclose(values[24:26], [Y[0] - np.diff(Y)[0] / 0.8, 17.0], rtol=1e-12)


def steep_tables(number):
    """Random tables whose points never fall, with chords that differ by up to eight powers of ten, and plateaus."""
    rng = np.random.default_rng(number)
    x = np.cumsum(rng.exponential(1.0, (number, 9)) ** rng.uniform(0.5, 3.0, (number, 1)) + 1e-3, axis=1)
    steps = 10.0 ** rng.uniform(-4.0, 4.0, (number, 9)) * (rng.random((number, 9)) > 0.2)
    return x, np.cumsum(steps, axis=1)


def test_points_that_never_fall_give_a_curve_that_never_falls():
    """Two hundred tables; with the sign changed, and with a fall beyond the neighbours of an interval."""
    x, y = steep_tables(200)
    at = x[:, :1] - 0.1 + (x[:, -1:] - x[:, :1] + 0.2) * np.linspace(0.0, 1.0, 1001)
    curve = jax.jit(jax.vmap(jax.vmap(local_spline.value, in_axes=(None, None, 0))))
    size = np.ptp(y, axis=1, keepdims=True)
    for sign in (1, -1):
        assert np.min(sign * np.diff(curve(x, sign * y, at)) / size) >= -1e-14
    # Where the four points around an interval rise, the curve rises there, whatever the others do.
    y[:, -1] = y[:, -2] - size[:, 0]
    rising = at < x[:, 6:7]
    falls = np.where(rising[:, 1:], np.diff(curve(x, y, at)) / size, 0.0)
    assert np.min(falls) >= -1e-14


def test_a_table_that_does_not_overshoot_is_the_spline_by_parabolas():
    """By SciPy's polynomials; convex and concave points, chords that differ by 2.9 times, and a vertex inside."""
    x = np.array([-1.0, -0.4, 0.0, 0.5, 1.5, 2.5, 3.0])
    for y in (x**2, np.exp(x), np.sin(x), np.array([0.0, 0.6, 1.76, 2.26, 5.16, 6.16, 7.61])):
        chords, h = np.diff(y) / np.diff(x), np.diff(x)
        slopes = (chords[:-1] * h[1:] + chords[1:] * h[:-1]) / (h[1:] + h[:-1])
        curvatures = 2 * np.diff(chords) / (h[1:] + h[:-1])
        slopes, curvatures = np.array([chords[0], *slopes, chords[-1]]), np.array([0.0, *curvatures, 0.0])
        spline = BPoly.from_derivatives(x, np.stack([y, slopes, curvatures], axis=1))
        s = np.linspace(x[0], x[-1], 101)
        np.testing.assert_allclose(value(jnp.asarray(x), jnp.asarray(y), s), spline(s), rtol=0, atol=1e-13)


@pytest.mark.slow
def test_derivatives_by_the_points_of_a_steep_table():
    """Of the curve and its integral; two continuous derivatives of the curve, also on its plateau."""
    x, y = np.array([0.0, 0.1, 0.2, 1.0, 1.3, 1.5]), np.array([1.0, 100.0, 101.0, 102.0, 102.0, 140.0])
    at = jnp.array([0.05, 0.13, 0.17, 0.7])

    def seen(y):
        one = lambda s: jnp.stack([f(jnp.asarray(x), y, s) for f in (local_spline.value, local_spline.integral)])
        return jax.vmap(one)(at).ravel()

    forward, reverse = jax.jit(jax.jacfwd(seen))(y), jax.jit(jax.jacrev(seen))(y)
    np.testing.assert_allclose(reverse, forward, rtol=0, atol=1e-12)
    # The curve up to the plateau is a smooth function of the points before it.
    expected = central_differences(jax.jit(seen), y, step=1e-4)
    np.testing.assert_allclose(forward[:, :3], expected[:, :3], rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(value(jnp.asarray(x), jnp.asarray(y), np.linspace(1.0, 1.3, 7)), 102.0, rtol=1e-14)
    one = lambda s: local_spline.value(jnp.asarray(x), jnp.asarray(y), s)
    rates = jax.jit(jax.vmap(lambda s: jnp.stack([jax.grad(one)(s), jax.grad(jax.grad(one))(s)])))
    np.testing.assert_allclose(rates(x - 1e-12), rates(x + 1e-12), rtol=0, atol=1e-4)


def test_a_damper_and_a_spring_of_a_table_with_a_knee():
    """The force stays between its points, so the damper dissipates ever more, and the spring's energy is convex."""
    knee = np.array([0.0, 0.1, 0.2, 1.0]), np.array([0.0, 100.0, 101.0, 102.0])
    parts = (
        mb.TableDamper("damper", "pin.angle", rates=knee[0], forces=knee[1]),
        mb.TableSpring("spring", "pin.angle", values=knee[0], forces=knee[1]),
    )
    system = wheel(planar, *parts)

    @jax.jit
    @jax.vmap
    def seen(x):
        own = jnp.zeros(3).at[2].set(x)
        slope = jax.grad(lambda q: system.potential_energy(0.0, q))(own)
        return system.force(0.0, own, jnp.zeros(3))[2], system.force(0.0, jnp.zeros(3), own)[2], slope[2]

    push, drag, slopes = map(np.asarray, seen(np.linspace(0.1, 0.2, 11)))
    assert np.all(np.diff(drag) < 0)
    np.testing.assert_allclose(drag[[0, -1]], (-100.0, -101.0), rtol=1e-12)
    np.testing.assert_allclose(push, drag, rtol=1e-12)
    np.testing.assert_allclose(slopes, -drag, rtol=1e-12)


def wheel(space, *forces, rate=0.0, angle=0.0):
    """A wheel that turns about its centre."""
    if space is planar:
        body = planar.Body("wheel", mass=MASS, inertia=INERTIA, angle=angle, angular_velocity=rate)
        pin = planar.Revolute("pin", "ground", "wheel", point=(0.0, 0.0))
    else:
        turned = mb.rotations.from_axis_angle((0.0, 0.0, 1.0), angle)
        state = {"orientation": turned, "angular_velocity": (0.0, 0.0, rate)}
        body = spatial.Body("wheel", mass=MASS, inertia=(0.3, 0.3, INERTIA), **state)
        axes = {"x_a": (1.0, 0.0, 0.0), "x_b": (1.0, 0.0, 0.0)}
        pin = spatial.Revolute("pin", "ground", "wheel", point=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), **axes)
    return mb.Scene([body], joints=[pin], forces=forces).compile()


def moment(system):
    return np.asarray(system.force(0.0, system.guess.q, system.guess.u))[-1]


def at(s):
    return float(value(jnp.asarray(X), jnp.asarray(Y), np.array([s]))[0])


def test_forces_by_tables():
    spring = mb.TableSpring("part", "pin.angle", values=X, forces=Y)
    damper = mb.TableDamper("part", "pin.angle", rates=X, forces=Y)
    np.testing.assert_allclose(moment(wheel(planar, spring, angle=0.3)), -at(0.3), rtol=1e-12)
    np.testing.assert_allclose(moment(wheel(planar, damper, rate=0.3)), -at(0.3), rtol=1e-12)
    motor = lambda control: mb.TableMotor("part", "pin.angle", speeds=X, torques=Y, gear=3.0, control=control)
    for control, factor, speed in ((0.5, 0.5, 0.9), (-0.25, -0.25, -0.9), (-7.0, -1.0, -0.9)):
        np.testing.assert_allclose(moment(wheel(planar, motor(control), rate=0.3)), 3 * factor * at(speed), rtol=1e-12)


def test_an_angle_in_space_counts_from_the_middle_of_the_table():
    table = mb.TableSpring("part", "pin.angle", values=X + 3.0, forces=Y)
    # The last is less than half a turn from the middle, but more from the first value.
    for angle in (3.0, 3.5 - 2 * np.pi, 5.8):
        expected = -at(angle % (2 * np.pi) - 3.0)
        np.testing.assert_allclose(moment(wheel(spatial, table, angle=angle)), expected, rtol=1e-11)


@pytest.mark.slow
def test_a_motor_of_a_straight_curve_that_lags():
    """Torque `T (1 − speed / n)` at full control: linear equations, in the plane and in space, in a batch."""
    top, n, lag, t1 = 2.0, 9.0, 0.1, 0.7
    speeds = np.array([0.0, 2.0, 5.0])
    curve = {"speeds": speeds, "torques": top * (1 - speeds / n)}
    ends = []
    for space in (planar, spatial):
        system = wheel(space, mb.TableMotor("motor", "pin.angle", control=1.0, lag=lag, activation=0.2, **curve))

        def end(control, system=system):
            changed = mb.with_parameters(system, {"motor.control": control})
            motion = mb.simulate(changed, mb.assemble(changed), t1=t1, rtol=1e-10, atol=1e-12)
            return motion["pin"].angle_rate[-1], motion["motor"].activation[-1]

        ends.append(jax.jit(jax.vmap(end))(jnp.array([0.6, 0.9])))
    for control, rate, activation in zip((0.6, 0.9), *ends[0], strict=True):
        level = lambda t, control=control: control + (0.2 - control) * np.exp(-t / lag)
        law = lambda t, v, level=level: level(t) * top * (1 - v / n) / INERTIA
        expected = solve_ivp(law, (0.0, t1), [0.0], rtol=1e-10, atol=1e-12).y[0, -1]
        np.testing.assert_allclose((rate, activation), (expected, level(t1)), rtol=0, atol=1e-8)
    np.testing.assert_allclose(ends[1], ends[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: mb.TableSpring("part", "pin.angle", values=X[:2], forces=Y[:2]), "at least 3, got shapes"),
        (lambda: mb.TableSpring("part", "pin.angle", values=X, forces=Y[:3]), "vectors of the same length"),
        (lambda: mb.TableSpring("part", "pin.angle", values=X[::-1], forces=Y), "values must ascend; sort the points"),
        (lambda: mb.TableDamper("part", "pin.angle", rates=0 * X, forces=Y), "rates must ascend"),
        (lambda: mb.TableMotor("part", "pin.angle", speeds=0 * X, torques=Y), "speeds must ascend"),
        (lambda: mb.TableMotor("part", "pin.angle", speeds=X, torques=np.nan * Y), "torques must be finite"),
        (lambda: mb.TableMotor("part", "pin.angle", speeds=X, torques=Y, activation=0.1), "an activation needs a lag"),
        (lambda: mb.TableMotor("part", "pin.angle", speeds=X, torques=Y, lag=0.0), "lag must be positive"),
    ],
)
def test_tables_that_are_refused(build, message):
    with pytest.raises(ValueError, match=f"'part': .*{message}"):
        wheel(planar, build())


def test_a_table_that_is_changed_to_descend():
    system = wheel(planar, mb.TableSpring("part", "pin.angle", values=X, forces=Y))
    with pytest.raises(ValueError, match="must ascend"):
        mb.with_parameters(system, {"part.values": X[::-1].copy()})
