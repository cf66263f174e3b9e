"""The tracked vehicle on tracks of shoes: how they are laid, rest, run over a bump, and keep energy and constraints."""

import functools
import types

import jax.numpy as jnp
import numpy as np
import pytest
from compiling import jit_to_run_long

import jaxmb as mb
from jaxmb import mechanisms
from jaxmb.mechanisms import ride
from jaxmb.mechanisms._shoe_track import laid

SHOE, PITCH, HEIGHT, RADII = 36.0, 0.1524, 0.06, {"sprocket": 0.2, "idler": 0.2, "wheel": 0.305}
TIMES = jnp.linspace(0.0, 1.0, 101)
BUMP = {"length": 5.0, "peak": 0.15}
WHEELS = np.array([[1.351 - 0.667 * k, 0.365] for k in range(5)])


@functools.cache
def vehicle():
    return mechanisms.tracked_vehicle(track="shoes")


@functools.cache
def motion():
    """One program for all motions of the vehicle."""
    make = lambda values, state, times, rtol: mb.simulate(
        mb.with_parameters(vehicle().system, values),
        state,
        t1=times[-1],
        saveat=times,
        rtol=rtol,
        max_steps=200_000,
    )
    return jit_to_run_long(make)


def changed(drive, start=4.0, without_losses=False):
    """Parameters by name: the torque of the drive, where the bump starts, and no damping and friction."""
    lossy = [name for name in mb.parameters(vehicle().system) if name.endswith((".damping", "friction.coefficient"))]
    known = mb.parameters(vehicle().system)
    values = {name: known[name] * (0.0 if without_losses else 1.0) for name in lossy}
    return values | {"drive.torque": drive, "road.terrain.start": start, "road_behind.terrain.start": start}


def bodies(sol, kind):
    q = np.asarray(sol.ys.q).reshape(len(sol.ts), -1, 3)
    return q[:, [k for k, name in enumerate(sol.system.body_names) if name.startswith(kind)]]


@pytest.mark.parametrize("number", [60, 61, 62])
def test_a_taut_track_lies_around_its_discs(number):
    """Its pins are one pitch apart, and none of its shoes is deep in a disc or farther out than the hull of all."""
    sprocket, idler = np.array([2.006, 0.58]), np.array([-1.824, 0.46])
    offset, pins = laid(mechanisms.Shoes(number=number), sprocket, idler, WHEELS, 0.305)
    assert len(pins) == number
    sides = np.roll(pins, -1, axis=0) - pins
    np.testing.assert_allclose(np.linalg.norm(sides, axis=1), PITCH, rtol=0, atol=1e-6)
    turns = np.diff(np.unwrap(np.arctan2(sides[:, 1], sides[:, 0])))
    # Counter-clockwise, never back but for the sides of the polygon that stands for circles.
    assert np.all(turns > -1e-3) and np.sum(turns) > 5.0
    normal = np.stack([-sides[:, 1], sides[:, 0]], axis=1) / PITCH
    discs = [(sprocket, 0.2), (idler - [offset, 0.0], 0.2), *((wheel, 0.305) for wheel in WHEELS)]
    gaps = [np.min(np.sum((centre - pins) * normal, axis=1)) - radius - HEIGHT / 2 for centre, radius in discs]
    assert np.all(np.abs(gaps[:2]) < 1e-2) and np.all(np.abs(gaps[2:]) < 1e-2)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"track": "belt"}, "track must be 'loop', 'shoes' or Shoes"),
        ({"track": 3}, "track must be 'loop', 'shoes' or Shoes"),
        ({"track": "shoes", "track_stiffness": 0.0}, "needs a track_stiffness > 0"),
    ],
)
def test_what_cannot_be_built_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        mechanisms.tracked_vehicle(**options)


def test_shoes_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="pitch must be positive"):
        mechanisms.Shoes(pitch=0.0)
    with pytest.raises(ValueError, match=r"number must be an integer, got 60\.5"):
        mechanisms.Shoes(number=60.5)
    with pytest.raises(ValueError, match=r"40 shoes of .* fit; about 6"):
        mechanisms.tracked_vehicle(track=mechanisms.Shoes(number=40))


def test_views_of_a_track_without_shoes():
    with pytest.raises(ValueError, match="needs the pins of shoes"):
        ride.track_tension(types.SimpleNamespace(system=mechanisms.pendulum().system))


@pytest.mark.slow
def test_statics():
    """At rest the ground bears the weight, the tensioner both strands around the idler, and where shoes hang freely
    they do so in a polygon whose slopes change from shoe to shoe by the weight of one over the tension.
    """
    system = vehicle().system
    state = mb.State(vehicle().state.q, 0.0 * vehicle().state.u)
    times = jnp.linspace(0.0, 4.0, 81)
    sol = motion()(changed(0.0), state, times, 1e-5)
    # Regularised friction lets tracks creep, and the vehicle with them.
    last = slice(-20, None)
    weight = 9.81 * float(np.sum(system.mass))
    lift = sum(np.sum(sol.forces[name][:, :, 1], axis=1) for name in ("road", "road_behind"))
    np.testing.assert_allclose(np.mean(lift[last]), weight, rtol=2e-3)
    # All but the shoes rests on these: the discs, whose tensions pull the wheels down as well.
    carried = 9.81 * float(np.sum(system.mass[: system.body_names.index("shoe1")]))
    on_wheels = np.sum(ride.wheel_loads(sol), axis=1)
    on_others = sum(sol.forces[f"{disc}_rim"][:, 0, 1] for disc in ("sprocket", "idler"))
    np.testing.assert_allclose(np.mean((on_wheels + on_others)[last]), carried, rtol=2e-3)

    tension = np.mean(np.asarray(ride.track_tension(sol))[last], axis=0)
    shoes, discs = bodies(sol, "shoe"), {kind: bodies(sol, kind) for kind in RADII}
    along = np.stack([np.cos(shoes[..., 2]), np.sin(shoes[..., 2])], axis=-1)
    across = np.stack([-along[..., 1], along[..., 0]], axis=-1)
    free = np.ones(shoes.shape[1], bool)
    for kind, radius in RADII.items():
        for disc in np.moveaxis(discs[kind], 1, 0):
            between = disc[:, None, :2] - shoes[..., :2]
            close = np.sum(between * across, axis=-1) - HEIGHT / 2 < radius + 2e-3
            free &= ~np.any(close & (np.abs(np.sum(between * along, axis=-1)) < PITCH), axis=0)
    top = np.flatnonzero(free & (along[-1, :, 0] < 0))
    # The span behind the sprocket: without a gap in the row of free shoes.
    span = top[: np.argmax(np.append(np.diff(top), 9) > 1) + 1]
    assert len(span) >= 6
    slopes = np.mean(np.tan(shoes[last][:, span, 2]), axis=0)
    hanging = SHOE * 9.81 / -np.polyfit(span, slopes, 1)[0]
    assert hanging == pytest.approx(np.mean(tension[span]), rel=0.02)
    assert np.ptp(tension[span]) < 0.02 * hanging
    # A free shoe of the strand from the idler to the last wheel.
    idler, hull = discs["idler"][last, 0], bodies(sol, "hull")[last, 0]
    lower = np.flatnonzero(free & (along[-1, :, 0] > 0) & (shoes[-1, :, 0] < idler[-1, 0] + 0.6))[0]
    strands = np.mean(tension[span]) + tension[lower] * np.mean(along[last][:, lower, 0])
    c, s = np.cos(hull[:, 2]), np.sin(hull[:, 2])
    fixed = hull[:, :2] + np.stack([-1.324 * c + 0.526 * s, -1.324 * s - 0.526 * c], axis=1)
    known = mb.parameters(system)
    length = np.linalg.norm(fixed - idler[:, :2], axis=1)
    push = float(known["tensioner.stiffness"]) * (float(known["tensioner.free_length"]) - np.mean(length))
    assert strands == pytest.approx(push, rel=0.02)
    assert 1e4 < hanging < 2e4


@pytest.mark.slow
def test_energy_is_kept_without_losses():
    state, times = vehicle().state, jnp.linspace(0.0, 0.2, 21)
    sol = motion()(changed(0.0, start=2.0, without_losses=True), state, times, 1e-9)
    size = np.max(np.abs(sol.kinetic_energy))
    assert np.ptp(sol.potential_energy) > 1e-3 * size
    np.testing.assert_allclose(sol.energy, sol.energy[0], rtol=0, atol=1e-8 * size)


@pytest.mark.slow
def test_over_a_long_bump_as_with_an_elastic_track():
    """At one place the hull is about as high and as much inclined as that of the vehicle on elastic tracks; over a
    bump as short as the distance of two wheels shoes bridge the slopes and lift it higher.
    """
    made, times = vehicle(), jnp.linspace(0.0, 1.5, 151)
    assert made.references is None
    system = made.system
    assert len(system.body_names) == 74 and system.nu - system.velocity_rank == 77
    longer = {f"{road}.terrain.{name}": x for road in ("road", "road_behind") for name, x in BUMP.items()}
    sol = motion()(changed(1200.0) | longer, made.state, times, 1e-5)
    loop = mechanisms.tracked_vehicle(torque=0.0, terrain=mb.terrain.Bump(start=4.0, **BUMP))
    other = mb.simulate(loop.system, loop.state, t1=1.5, saveat=times)
    at = np.linspace(0.1, 7.1, 141)

    def along(sol, values):
        return np.interp(at, sol["hull"].position[:, 0], values - values[0])

    for of, bound in ((lambda hull: hull.position[:, 1], 0.015), (lambda hull: hull.angle, 0.012)):
        found, expected = (along(own, np.asarray(of(own["hull"]))) for own in (sol, other))
        np.testing.assert_allclose(found, expected, rtol=0, atol=bound)
        assert np.max(found) == pytest.approx(np.max(expected), rel=0.08)
    assert np.all(sol.constraint_violation.position <= 1e-12)
    assert np.all(sol.constraint_violation.velocity <= 1e-12)
    closer = motion()(changed(1200.0) | longer, made.state, times, 1e-7)
    np.testing.assert_allclose(sol["hull"].position, closer["hull"].position, rtol=0, atol=1e-4)
    # Running needs the tension that turns the shoes' momentum around, m v² / pitch, on top of that at rest.
    tension = np.mean(ride.track_tension(sol)[10:50])
    assert tension == pytest.approx(1.5e4 + SHOE * 5.0**2 / PITCH, rel=0.1)


@pytest.mark.slow
def test_several_hundred_short_shoes_run_over_a_bump():
    """Two carriers on tracks of half the pitch, which turn sharply between wheels: no wheel sinks in at the corners
    between two shoes, and no track buckles.
    """
    pitch, height = 0.5 * PITCH, 0.05
    short = mechanisms.tracked_vehicle(units=2, track=mechanisms.Shoes(pitch=pitch, mass=0.5 * SHOE, height=height))
    names = short.system.body_names
    assert len(names) == 268
    run = jit_to_run_long(
        lambda state: mb.simulate(short.system, state, t1=1.0, rtol=1e-4, saveat=TIMES, max_steps=40_000)
    )
    sol = run(short.state)
    assert np.all(sol.constraint_violation.position <= 1e-12)
    for p in ("", "rear_"):
        shoes, wheels = (bodies(sol, f"{p}{kind}") for kind in ("shoe", "wheel"))
        assert len(shoes[0]) == 121 and len(wheels[0]) == 5
        bend = np.diff(np.concatenate([shoes[..., 2], shoes[:, :1, 2]], axis=1), axis=1)
        assert np.max(np.abs((bend + np.pi) % (2 * np.pi) - np.pi)) < 0.7
        between = wheels[:, :, None, :2] - shoes[:, None, :, :2]
        c, s = np.cos(shoes[:, None, :, 2]), np.sin(shoes[:, None, :, 2])
        along, across = c * between[..., 0] + s * between[..., 1], c * between[..., 1] - s * between[..., 0]
        distance = np.hypot(np.maximum(np.abs(along) - pitch / 2, 0.0), across - height / 2)
        assert np.min(distance) > RADII["wheel"] - 0.03
    assert np.min(np.diff(sol["hull"].position[:, 0])) > 0.0
