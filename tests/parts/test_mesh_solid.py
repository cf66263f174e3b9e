"""Bodies from closed surfaces in files have the mass, centre and inertia of the solids."""

import numpy as np
import pytest

import jaxmb as mb
from jaxmb import spatial

trimesh = pytest.importorskip("trimesh")


def written(mesh, path, shift=(0.0, 0.0, 0.0), turn=None):
    mesh.apply_transform(np.eye(4) if turn is None else turn)
    mesh.apply_translation(shift)
    mesh.export(path)
    return path


def test_body_from_mesh_of_a_box(tmp_path):
    """In millimetres, off the origin: by the closed form."""
    file = written(trimesh.creation.box((100.0, 20.0, 10.0)), tmp_path / "box.stl", (300.0, 5.0, -40.0))
    body = spatial.Body.from_mesh("box", file, density=2700.0, scale=1e-3, position=(1.0, 0.0, 0.0))
    mass = 2700.0 * 0.1 * 0.02 * 0.01
    np.testing.assert_allclose(body.mass, mass, rtol=1e-6)
    np.testing.assert_allclose(body.centre, (0.3, 0.005, -0.04), atol=1e-7)
    np.testing.assert_allclose(body.inertia, spatial.box(mass, 0.1, 0.02, 0.01), atol=1e-6 * mass)
    np.testing.assert_array_equal(body.position, (1.0, 0.0, 0.0))


def test_body_from_mesh_of_a_turned_cylinder_has_products_of_inertia(tmp_path):
    turn = trimesh.transformations.rotation_matrix(0.7, (1.0, 2.0, 0.5))
    file = written(trimesh.creation.cylinder(0.1, 0.6, sections=400), tmp_path / "rod.ply", turn=turn)
    body = spatial.Body.from_mesh("rod", file, density=1000.0)
    mass = 1000.0 * np.pi * 0.1**2 * 0.6
    straight = np.diag([mass * (3 * 0.1**2 + 0.6**2) / 12] * 2 + [mass * 0.1**2 / 2])
    np.testing.assert_allclose(body.mass, mass, rtol=1e-4)
    np.testing.assert_allclose(body.inertia, turn[:3, :3] @ straight @ turn[:3, :3].T, rtol=1e-3, atol=1e-4 * mass)
    assert np.abs(np.asarray(body.inertia)[0, 1]) > 1e-3 * mass


def test_body_from_mesh_whose_triangles_face_inwards(tmp_path):
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    box.invert()
    body = spatial.Body.from_mesh("box", written(box, tmp_path / "box.obj"), density=2.0)
    np.testing.assert_allclose(body.mass, 12.0, rtol=1e-6)


def test_body_from_mesh_refuses_a_hole(tmp_path):
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.update_faces(np.arange(11))
    file = written(box, tmp_path / "open.stl")
    with pytest.raises(ValueError, match=r"Body 'box': .*open\.stl': the surface is not closed"):
        spatial.Body.from_mesh("box", file, density=1.0)


def test_other_units():
    assert (mb.deg, mb.bar, mb.rpm) == (np.pi / 180, 1e5, pytest.approx(2 * np.pi / 60))
