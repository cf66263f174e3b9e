"""Charts near positions where constraints lose rank: linkages that lie flat go on as their momentum tells."""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folding():
    """A slider-crank with a rod as long as its crank, which folds where the crank stands upright, beside a skate: with
    its row of velocities, coordinates have a stored factor.
    """
    bars = [
        planar.Body("crank", mass=1.0, inertia=0.02, position=(0.2, 0.0)),
        planar.Body("rod", mass=1.0, inertia=0.02, position=(0.6, 0.0)),
        planar.Body("skate", mass=1.0, inertia=0.02, position=(0.0, -1.0)),
    ]
    joints = [
        planar.Revolute("pin", "ground", "crank", point=(0.0, 0.0)),
        planar.Revolute("elbow", "crank", "rod", point=(0.4, 0.0)),
        planar.PointOnLine("slider", "ground", "rod", axis_a=(1.0, 0.0), point_a=(0.0, 0.0), point_b=(0.2, 0.0)),
        planar.KnifeEdge("blade", "skate", axis=(1.0, 0.0)),
    ]
    return mb.Scene(bars, joints=joints).compile()


def test_a_stored_position_factor_serves_no_other_side_of_a_flat_position(folding):
    """Newton's method failed after it, however short the steps were."""

    @jax.jit
    def run(speed, rtol):
        start = mb.State(
            jnp.array([0.2, 0, 0, 0.6, 0, 0, 0, -1, 0]),
            speed * jnp.array([0, 0.2, 1, 0, 0.2, -1, 0, 0, 0.3]),
        )
        motion = mb.simulate(
            folding, start, t1=5.0, rtol=rtol, saveat=jnp.linspace(0, 5, 11), max_steps=2000, throw=False
        )
        return motion["crank"].angle, motion["rod"].angle, motion.energy

    for speed in (3.0, -5.0):
        for rtol in (1e-6, 1e-9):
            crank, rod, energy = run(speed, rtol)
            np.testing.assert_allclose(rod + crank, 0.0, atol=100 * rtol)
            np.testing.assert_allclose(energy, energy[0], rtol=100 * rtol)
            assert np.abs(crank[-1]) > 6.0


# Linkages of bars that lie flat in passing, in the plane or in space, with their motion in closed form. At such a
# position the constraints lose rank and other motions branch off; the bars go on as their momentum tells.

# How the plane of the linkages lies in space.
_PLANE = np.array([0.4, 0.3, -0.6, 0.5]) / np.linalg.norm([0.4, 0.3, -0.6, 0.5])


def _product(a, b):
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return jnp.concatenate([scalar[None], a[0] * b[1:] + b[0] * a[1:] + jnp.cross(a[1:], b[1:])])


def _turned(v):
    """A vector of the plane in space."""
    conjugate = jnp.asarray(_PLANE) * jnp.array([1.0, -1.0, -1.0, -1.0])
    return _product(_product(jnp.asarray(_PLANE), jnp.concatenate([jnp.zeros(1), v, jnp.zeros(1)])), conjugate)[1:]


def along(angle):
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)])


@dataclasses.dataclass(frozen=True)
class FlatLinkage:
    """Uniform slender bars of 1 kg on hinges.

    **Fields:** `hinges`: name, bodies, and where on them, in numbers along bars and points of the ground; `poses(x)`:
    centre and angle of each bar by name; `lengths` of the bars; the coordinates of the scene; `line`: a bar whose lower
    end slides along x, or None; `kinds` of hinges in space other than `spatial.Revolute`.
    """

    hinges: Sequence[tuple]
    poses: Callable
    lengths: dict[str, float]
    start: tuple[float, ...]
    line: str | None = None
    kinds: dict[str, type] = dataclasses.field(default_factory=dict)

    def system(self, in_space: bool):
        """The compiled scene."""
        bodies, joints = [], []
        for name, (centre, angle) in self.poses(jnp.array(self.start)).items():
            inertia = self.lengths[name] ** 2 / 12
            if in_space:
                turn = _product(jnp.asarray(_PLANE), jnp.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)]))
                own = {"inertia": np.diag(inertia * np.array([0.1, 1.0, 1.0])), "orientation": turn}
                bodies.append(spatial.Body(name, mass=1.0, position=_turned(centre), **own))
            else:
                bodies.append(planar.Body(name, mass=1.0, inertia=inertia, position=centre, angle=float(angle)))
        point = lambda s: jnp.zeros(3 if in_space else 2).at[0].set(s)
        normal = _product(_product(_PLANE, np.array([0.0, 0, 0, 1])), _PLANE * np.array([1.0, -1, -1, -1]))[1:]
        for name, a, b, at_a, at_b in self.hinges:
            on_ground = jnp.array([at_a, 0.0])
            place = point(at_a) if a != "ground" else _turned(on_ground) if in_space else on_ground
            at = {"point_a": place, "point_b": point(at_b)}
            if not in_space:
                joints.append(planar.Revolute(name, a, b, **at))
                continue
            axis = normal if a == "ground" else (0.0, 0.0, 1.0)
            kind = self.kinds.get(name, spatial.Revolute)
            axes = {spatial.Revolute: {"axis_a": axis, "axis_b": (0.0, 0.0, 1.0)}, spatial.Spherical: {}}
            axes[spatial.Universal] = {"axis_a": axis, "axis_b": (0.0, 1.0, 0.0)}
            joints.append(kind(name, a, b, **at, **axes[kind]))
        if self.line is not None:
            part, axis = (spatial, _turned(jnp.array([1.0, 0.0]))) if in_space else (planar, (1.0, 0.0))
            at = {"point_a": point(0.0), "point_b": point(-self.lengths[self.line] / 2)}
            joints.append(part.PointOnLine("line", "ground", self.line, axis_a=axis, **at))
        return mb.Scene(bodies, joints=joints).compile()

    def state(self, x, rates, in_space):
        """The state at coordinates x and their rates."""
        flat = lambda x: [jnp.concatenate([centre, angle[None]]) for centre, angle in self.poses(x).values()]
        at, velocity = jax.jvp(flat, (x,), (rates,))
        if not in_space:
            return mb.State(jnp.concatenate(at), jnp.concatenate(velocity))
        half = [jnp.stack([jnp.cos(p[2] / 2), 0.0 * p[2], 0.0 * p[2], jnp.sin(p[2] / 2)]) for p in at]
        q = [jnp.concatenate([_turned(p[:2]), _product(jnp.asarray(_PLANE), h)]) for p, h in zip(at, half, strict=True)]
        u = [jnp.concatenate([_turned(v[:2]), jnp.zeros(2), v[2:]]) for v in velocity]
        return mb.State(jnp.concatenate(q), jnp.concatenate(u))

    def path(self, x, rates, times, substeps=200):
        """The coordinates at times, by Lagrange's equations and steps of Runge and Kutta, shape (times, freedoms)."""
        length = jnp.array([self.lengths[name] for name in self.poses(x)])

        def energy(x, rates):
            flat = lambda x: jnp.stack([jnp.append(c, a) for c, a in self.poses(x).values()])
            _, v = jax.jvp(flat, (x,), (rates,))
            return 0.5 * jnp.sum(v[:, 0] ** 2 + v[:, 1] ** 2 + length**2 / 12 * v[:, 2] ** 2)

        def field(y):
            x, rates = jnp.split(y, 2)
            _, rise = jax.jvp(lambda x: jax.grad(energy, 1)(x, rates), (x,), (rates,))
            force = jax.grad(energy)(x, rates) - rise
            return jnp.append(rates, jnp.linalg.solve(jax.hessian(energy, 1)(x, rates), force))

        def step(_, y, h):
            a = field(y)
            b = field(y + h / 2 * a)
            c = field(y + h / 2 * b)
            return y + h / 6 * (a + 2 * b + 2 * c + field(y + h * c))

        def interval(y, span):
            y = jax.lax.fori_loop(0, substeps, lambda k, y: step(k, y, span / substeps), y)
            return y, y[: x.size]

        _, out = jax.lax.scan(interval, jnp.append(x, rates), jnp.diff(times))
        return jnp.concatenate([x[None], out])

    def centres(self, path, in_space):
        """The centres of the bars along a path, by name."""
        place = _turned if in_space else lambda centre: centre
        return jax.vmap(lambda x: {name: place(c) for name, (c, _) in self.poses(x).items()})(path)


def _parallel(count, kinds=None, l=0.4, d=1.0):
    """Parallel cranks that carry level bars in a row."""
    hinges = [(f"A{k}", "ground", f"crank{k}", k * d, -l / 2) for k in range(count)]
    for k in range(1, count):
        hinges.append((f"P{k}", f"crank{k - 1}", f"level{k}", l / 2, -d / 2))
        hinges.append((f"Q{k}", f"level{k}", f"crank{k}", d / 2, l / 2))

    def poses(x):
        right, tip = jnp.array([d, 0.0]), l * along(x[0])
        out = {f"crank{k}": (tip / 2 + k * right, x[0]) for k in range(count)}
        return out | {f"level{k}": (tip + (k - 0.5) * right, 0 * x[0]) for k in range(1, count)}

    lengths = {f"crank{k}": l for k in range(count)} | {f"level{k}": d for k in range(1, count)}
    return FlatLinkage(hinges, poses, lengths, (0.6,), kinds=kinds or {})


def _scissors(l=1.0):
    """Two crossed bars, their lower ends on a hinge and on the line."""
    hinges = [("foot", "ground", "a", 0.0, -l / 2), ("middle", "a", "b", 0.0, 0.0)]
    poses = lambda x: {"a": (l / 2 * along(x[0]), x[0]), "b": (l / 2 * along(x[0]), jnp.pi - x[0])}
    return FlatLinkage(hinges, poses, {"a": l, "b": l}, (0.6,), "b")


def _pantograph(l=0.7, r=0.25, w=0.8):
    """An arm and a crank on one axis; a rod parallel to the arm keeps the forearm parallel to the crank."""
    middle = (w - r) / 2
    hinges = [
        ("A", "ground", "arm", 0.0, -l / 2),
        ("C", "ground", "crank", 0.0, -r / 2),
        ("R", "crank", "rod", r / 2, -l / 2),
        ("E", "arm", "forearm", l / 2, -middle),
        ("F", "rod", "forearm", l / 2, r - middle),
    ]

    def poses(x):
        a, b = along(x[0]), along(x[1])
        return {
            "arm": (l / 2 * a, x[0]),
            "crank": (r / 2 * b, x[1]),
            "rod": (r * b + l / 2 * a, x[0]),
            "forearm": (l * a + (w - r) / 2 * b, x[1]),
        }

    return FlatLinkage(hinges, poses, {"arm": l, "crank": r, "rod": l, "forearm": w + r}, (0.3, 1.5))


LINKAGES = {
    "parallelogram": _parallel(2),
    "parallelogram without redundancy": _parallel(2, {"P1": spatial.Universal, "Q1": spatial.Spherical}),
    "row of parallelograms": _parallel(3),
    "scissors": _scissors(),
    "pantograph": _pantograph(),
}
CASES = [
    ("parallelogram", False),
    ("parallelogram", True),
    ("parallelogram without redundancy", True),
    ("row of parallelograms", False),
    ("scissors", True),
    ("pantograph", False),
]


@pytest.mark.parametrize("name, in_space", CASES)
def test_linkages_go_on_after_flat_positions(name, in_space):
    """From random states: positions are those of Lagrange's equations for the freedoms of the linkage."""
    linkage, rng, times = LINKAGES[name], np.random.default_rng(7), jnp.linspace(0.0, 2.0, 9)
    system = linkage.system(in_space)

    @jax.jit
    def run(x, rates, rtol):
        start = linkage.state(x, rates, in_space)
        motion = mb.simulate(system, start, t1=2.0, rtol=rtol, saveat=times, max_steps=3000, throw=False)
        centres = linkage.centres(linkage.path(x, rates, times), in_space)
        return motion.result, jnp.max(jnp.stack([jnp.abs(motion[k].position - at) for k, at in centres.items()]))

    # Where two linkages lie flat at once, steps in the plane may creep up to that position at 1e-10.
    finest = 1e-9 if name == "row of parallelograms" else 1e-10
    for rtol in 3 * (1e-4, 1e-6, 1e-8, finest):
        x = np.array(linkage.start) + rng.uniform(-0.3, 0.6, len(linkage.start))
        rates = rng.choice([-1.0, 1.0], x.size) * rng.uniform(1.0, 6.0, x.size)
        result, error = run(x, rates, rtol)
        assert result == mb.RESULTS.successful and error < 300 * rtol + 1e-8, (rtol, result, error)


def test_derivatives_beyond_a_flat_position(folding):
    """Forward, reverse, and central differences of a tighter solution."""

    def end(speed, rtol):
        rates = jnp.array([0, 0.2, 1, 0, 0.2, -1, 0, 0, 0.3])
        start = mb.State(jnp.array([0.2, 0, 0, 0.6, 0, 0, 0, -1, 0]), speed * rates)
        return mb.simulate(folding, start, t1=1.0, rtol=rtol, max_steps=400)["crank"].angle[-1]

    forward = jax.jit(jax.jvp, static_argnums=0)(lambda s: end(s, 1e-9), (3.0,), (1.0,))[1]
    reverse = jax.jit(jax.grad(lambda s: end(s, 1e-9)))(3.0)
    value = jax.jit(lambda s: end(s, 1e-10))
    assert value(3.0) > np.pi / 2 + 0.3
    np.testing.assert_allclose(forward, (value(3.0 + 1e-3) - value(3.0 - 1e-3)) / 2e-3, rtol=1e-5)
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
