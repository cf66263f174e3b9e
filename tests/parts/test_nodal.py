"""Reduced finite element models bend under loads at their interfaces, and vibrate, as the whole models do."""

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from test_elastic import springs

import jaxmb as mb
from jaxmb import planar, spatial

# A truss of two rows of nodes.
PLACES = np.array([[0.1 * k, 0.1 * j] for k in range(6) for j in range(2)])
ENDS = {"base": [0, 1], "tip": [10, 11]}


def truss(**changed):
    near = springs(PLACES, 1e4).reshape(12, 2, 12, 2).copy()
    for i in range(12):
        for j in range(12):
            if i != j and np.linalg.norm(PLACES[i] - PLACES[j]) > 0.15:
                near[i, :, i] += near[i, :, j]
                near[i, :, j] = 0.0
    root = np.eye(12) + 0.3 * np.eye(12, k=1)
    return {"nodes": PLACES, "mass": 0.01 * root @ root.T, "stiffness": near.reshape(24, 24)} | changed


def held_base(model):
    """The rows that are the mean motion of the base, by hand."""
    out = np.zeros((3, 24))
    out[0, [0, 2]] = out[1, [1, 3]] = 0.5
    out[2, [0, 2]] = -5.0, 5.0
    out[2] *= -1.0
    return out


def test_reduced_model_bends_as_the_whole_one():
    """The displacement and turn of one interface by a load there, with the other held, are exact without vibrations."""
    model = truss()
    body, (base, tip) = planar.ElasticBody.from_nodes("arm", model, interfaces=ENDS)
    assert len(body.modes) == 3
    np.testing.assert_allclose(np.concatenate([base.shapes, base.turning]), 0.0, atol=1e-12)
    held = held_base(model)
    system = np.block([[model["stiffness"], held.T], [held, np.zeros((3, 3))]])
    load = np.zeros(27)
    load[[20, 22]], load[[21, 23]] = 0.5 * 3.0, 0.5 * 2.0
    moved = np.linalg.solve(system, load)[:24].reshape(12, 2)
    zeta = np.linalg.solve(np.asarray(body.stiffness), np.asarray(tip.shapes).T @ [3.0, 2.0])
    np.testing.assert_allclose(tip.shapes @ zeta, moved[[10, 11]].mean(axis=0), rtol=1e-9)
    turn = (moved[10, 0] - moved[11, 0]) / 0.1
    np.testing.assert_allclose(tip.turning @ zeta, [turn], rtol=1e-9)


def test_reduced_model_vibrates_as_the_whole_one():
    """With all vibrations, and its first interface held; few vibrations come from above."""
    model = truss(mass=scipy.sparse.csr_array(truss()["mass"]), stiffness=scipy.sparse.csr_array(truss()["stiffness"]))
    kept = scipy.linalg.null_space(held_base(model))
    mass = np.kron(truss()["mass"], np.eye(2))
    exact = scipy.linalg.eigh(kept.T @ truss()["stiffness"] @ kept, kept.T @ mass @ kept)[0]
    for fixed, count, tolerance in ((18, 21, 1e-8), (4, 3, 0.02)):
        body, _ = planar.ElasticBody.from_nodes("arm", model, interfaces=ENDS, fixed=fixed)
        modal = np.einsum("klaa->kl", body.modal_products)
        np.testing.assert_allclose(modal - np.diag(np.diag(modal)), 0.0, atol=1e-12)
        found = np.diag(body.stiffness) / np.diag(modal)
        assert np.all(found[:count] > exact[:count] * (1 - 1e-9))
        np.testing.assert_allclose(found[:count], exact[:count], rtol=tolerance)


def test_model_from_a_file(tmp_path):
    np.savez(tmp_path / "arm.npz", **truss())
    body, frames = planar.ElasticBody.from_nodes("arm", tmp_path / "arm.npz", interfaces=ENDS, damping=1e-3)
    expected, _ = planar.ElasticBody.from_nodes("arm", truss(), interfaces=ENDS)
    np.testing.assert_array_equal(body.stiffness, expected.stiffness)
    np.testing.assert_allclose(body.damping, 1e-3 * body.stiffness, rtol=1e-12)
    assert [frame.name for frame in frames] == ["base", "tip"]
    assert mb.Scene([body], frames=frames).compile().nu == 6


TURN = np.stack([-PLACES[:, 1], PLACES[:, 0]], axis=1).reshape(24, 1)
REFUSED = {
    "no mass": (truss(mass=-np.eye(12)), ENDS, 0, "must be positive"),
    "asymmetric": (truss(mass=np.eye(12) + np.eye(12, k=1)), ENDS, 0, "mass must be symmetric"),
    "clamped": (truss(stiffness=truss()["stiffness"] + np.eye(24)), ENDS, 0, "stiffness resists rigid motions"),
    "shape": (truss(stiffness=np.eye(12)), ENDS, 0, r"stiffness must have shape \(24, 24\)"),
    "nodes": (truss(nodes=np.zeros((12, 3))), ENDS, 0, r"nodes must have shape \(n, 2\)"),
    "missing": ({"nodes": PLACES}, ENDS, 0, "the model needs 'mass', and has 'nodes'"),
    "outside": (truss(), {"base": [0, 12]}, 0, "'base' must have indices of nodes, from 0 to 11"),
    "point": (truss(), {"base": [3]}, 1, "'base' lie in a line or a point"),
    "no interface": (truss(), {}, 1, "name an interface"),
    "too many": (truss(), ENDS, 19, "fixed must be from 0 to 18"),
    "none": (truss(), {"base": [0, 1]}, 0, "0 modes"),
    "rigid": (truss(modes=np.concatenate([np.eye(24, 2), TURN], axis=1)), ENDS, 0, "mode_3 contain a rigid motion"),
    "twice": (truss(modes=np.eye(24)[:, [2, 5, 2]]), ENDS, 0, "mode_1, mode_3 contain a rigid motion, or depend"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_model_is_refused(case):
    model, interfaces, fixed, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        planar.ElasticBody.from_nodes("arm", model, interfaces=interfaces, fixed=fixed)


def test_interface_in_space_needs_three_nodes():
    nodes = np.random.default_rng(0).normal(size=(5, 3))
    model = {"nodes": nodes, "mass": np.ones(5), "stiffness": springs(nodes, 10.0)}
    with pytest.raises(ValueError, match="lie in a line or a point"):
        spatial.ElasticBody.from_nodes("body", model, interfaces={"base": [0, 1]})
