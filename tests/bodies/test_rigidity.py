"""Bodies without freedom: trusses of any length are accepted, small disagreements of joints are refused by name."""

import numpy as np
import pytest

import jaxmb as mb
from jaxmb import planar, spatial


def warren(bays):
    """Nodes and bars of a truss with triangular bays; it is determinate with the first and the third node held."""
    nodes = np.array([(0.5 * k, 0.8 * (k % 2)) for k in range(bays + 2)])
    return nodes, [(k, k + 1) for k in range(bays + 1)] + [(k, k + 2) for k in range(1, bays)]


def pratt(bays, crossed):
    """A cantilever; some bays have both diagonals."""
    nodes = np.array([(float(k), y) for y in (0.0, 1.0) for k in range(bays + 1)])
    top = bays + 1
    chords = [(k, k + 1) for k in range(bays)] + [(top + k, top + k + 1) for k in range(bays)]
    posts = [(k, top + k) for k in range(1, bays + 1)]
    return nodes, [*chords, *posts, *((k, top + k + 1) for k in range(bays)), *((k + 1, top + k) for k in crossed)]


def mast(storeys):
    """A mast on three feet, in space."""
    triangle = [(0.0, 0.0), (1.0, 0.0), (0.5, 0.9)]
    nodes = np.array([(x, y, float(z)) for z in range(storeys + 1) for x, y in triangle])
    edges = []
    for k in range(0, 3 * storeys, 3):
        edges += [(k + i, k + i + 3) for i in range(3)] + [(k + 3, k + 4), (k + 4, k + 5), (k + 3, k + 5)]
        edges += [(k, k + 4), (k + 1, k + 5), (k + 2, k + 3)]
    return nodes, edges


def of_bars(nodes, edges, held):
    """Bars with mass, pinned to each other."""
    bars, pins, at = [], [], {}
    for i, j in edges:
        size, name = np.linalg.norm(nodes[j] - nodes[i]), f"{i}-{j}"
        bars.append(planar.Body(name, mass=1.0, inertia=size**2 / 12, position=(nodes[i] + nodes[j]) / 2))
        for k in (i, j):
            at.setdefault(k, []).append(name)
    for k, names in at.items():
        first, others = ("ground", names) if k in held else (names[0], names[1:])
        pins += [planar.Revolute(f"{k}:{name}", first, name, point=nodes[k]) for name in others]
    return mb.Scene(bars, joints=pins)


def of_rods(nodes, edges, held, more=()):
    """Point masses on rods without mass."""
    space = planar if nodes.shape[1] == 2 else spatial
    name = lambda k: "ground" if k in held else f"n{k}"
    place = lambda k: nodes[k] if k in held else np.zeros_like(nodes[k])
    masses = [space.PointMass(name(k), mass=1.0, position=x) for k, x in enumerate(nodes) if k not in held]
    rods = [space.Distance(f"{i}-{j}", name(i), name(j), point_a=place(i), point_b=place(j)) for i, j in edges]
    bodies, joints = more or ((), ())
    return mb.Scene([*masses, *bodies], joints=[*rods, *joints])


def platform(misfit, below, points, feet=((0.0, 0.0), (1.0, 0.0), (2.0, 0.0))):
    """A platform on parallel rods from these feet, points of bodies below; the second head has a misfit."""
    heads = np.add(feet, (0.0, 1.0))
    centre = heads.mean(axis=0)
    heads[1, 0] += misfit
    body = planar.Body("platform", mass=1.0, inertia=0.1, position=centre)
    rods = [
        planar.Distance(f"rod{k}", name, "platform", point_a=point, point_b=head - centre)
        for k, (name, point, head) in enumerate(zip(below, points, heads, strict=True))
    ]
    return [body], rods


RIGID = {
    "a truss of 41 bars": lambda: of_bars(*warren(20), (0, 2)),
    "a truss of 41 rods": lambda: of_rods(*warren(20), (0, 2)),
    "in mm": lambda: of_bars(warren(20)[0] * 1e3, warren(20)[1], (0, 2)),
    "in km": lambda: of_rods(warren(20)[0] * 1e-3, warren(20)[1], (0, 2)),
    "a mast of ten storeys": lambda: of_rods(*mast(10), (0, 1, 2)),
    "a shallow arch": lambda: of_bars(np.array([(0.0, 0.0), (1.0, 0.03), (2.0, 0.0)]), [(0, 1), (1, 2)], (0, 2)),
    "with all diagonals": lambda: of_rods(*pratt(10, crossed=range(10)), (0, 11)),
    "bars with all diagonals": lambda: of_bars(*pratt(10, crossed=range(10)), (0, 11)),
}


@pytest.mark.slow(but=("a truss of 41 rods", "a shallow arch", "in mm"))
@pytest.mark.parametrize("case", RIGID)
def test_truss_that_is_rigid_is_accepted(case):
    system = RIGID[case]().compile()
    assert system.velocity_rank == system.nu
    assert len(system.implied) == (10 if "all diagonals" in case else 0)


def on_truss(misfit):
    nodes, edges = warren(20)
    return of_rods(nodes, edges, (0, 2), platform(misfit, ["n9", "n11", "n13"], np.zeros((3, 2)), nodes[[9, 11, 13]]))


def on_four(misfit):
    feet = [(float(k), 0.0) for k in range(4)]
    body, rods = platform(misfit, ["ground"] * 4, feet, feet)
    return mb.Scene(body, joints=rods)


def on_cart(misfit):
    """The cart is free."""
    body, rods = platform(misfit, ["cart"] * 3, [(float(k), 0.0) for k in range(3)])
    cart = planar.Body("cart", mass=1.0, inertia=1.0, position=(0.0, 0.0))
    return mb.Scene([cart, *body], joints=rods)


LOCKED = {
    "a flat arch": (
        lambda: of_rods(np.array([(0.0, 0.0), (1.0, 1e-3), (2.0, 0.0)]), [(0, 1), (1, 2)], (0, 2)),
        r"n1 cannot move: 0-1, 1-2 leave no degree of freedom, but with dimensions that differ only slightly",
    ),
    "a platform on a long truss": (
        lambda: on_truss(1e-3),
        r"^n9, .*n13, platform cannot move: 9-10, .*rod2 .* leave no",
    ),
    "a platform on four rods": (
        lambda: on_four(1e-3),
        r"^platform cannot move: rod0, rod1, rod2, rod3 leave no degree",
    ),
    "rods on a cart": (lambda: on_cart(1e-3), r"^platform cannot move: rod0, rod1, rod2 leave no degree of freedom"),
}


@pytest.mark.parametrize("case", LOCKED)
def test_body_that_a_small_disagreement_locks_is_refused_by_name(case):
    make, message = LOCKED[case]
    with pytest.raises(ValueError, match=message):
        make().compile()


def test_body_that_rods_lock_firmly_is_accepted():
    system = on_truss(0.2).compile()
    assert system.velocity_rank == system.nu


def grown(rng, count, flat=None):
    """A determinate truss to which each node was added on two bars, that of number `flat` nearly between their ends."""
    nodes, edges = [np.array([0.0, 0.0]), np.array([1.0, 0.0])], []
    while len(nodes) < count + 2:
        i, j = rng.choice(len(nodes), 2, replace=False).tolist()
        along = nodes[j] - nodes[i]
        if not 0.3 < np.hypot(*along) < 3.0:
            continue
        height = 1e-3 if len(nodes) - 2 == flat else rng.uniform(0.3, 0.8)
        side = rng.choice([-1.0, 1.0]) * height * np.array([-along[1], along[0]])
        edges += [(i, len(nodes)), (j, len(nodes))]
        nodes.append(nodes[i] + rng.uniform(0.3, 0.7) * along + side)
    return np.array(nodes), edges


def check_random(seed):
    rng = np.random.default_rng(seed)
    system = of_rods(*grown(rng, 6), (0, 1)).compile()
    assert system.velocity_rank == system.nu
    with pytest.raises(ValueError, match=r"\bn5\b.* cannot move"):
        of_rods(*grown(rng, 6, flat=3), (0, 1)).compile()


def test_truss_that_is_random():
    check_random(0)


@pytest.mark.slow
def test_trusses_that_are_random():
    for seed in range(1, 6):
        check_random(seed)


@pytest.mark.slow
def test_truss_of_many_has_no_dense_matrix(monkeypatch):
    largest, svd = 0, np.linalg.svd

    def watched(matrix, *arguments, **options):
        nonlocal largest
        largest = max(largest, *np.shape(matrix)[-2:])
        return svd(matrix, *arguments, **options)

    monkeypatch.setattr(np.linalg, "svd", watched)
    of_bars(*warren(133), (0, 2)).compile()
    assert largest < 100
