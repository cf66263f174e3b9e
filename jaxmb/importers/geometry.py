"""Shapes of URDF and SDF, whose elements have the same names and meanings in both."""

import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np

from ..parts.shapes import AbstractShape, Box, Color, Cylinder, Ellipsoid, Ground, Mesh, Sphere, along, capsule
from .description import Machine
from .notes import Notes
from .source import Resources
from .xml_tree import Element

# The words that leave out the elements of a tag.
_WORDS = {"visual": "pictures", "collision": "collisions"}


def color_of(rgba: Any) -> Color | None:
    """Red, green and blue from 0 to 255 of numbers in [0, 1]; None if invisible."""
    r, g, b = (round(255 * min(max(float(value), 0.0), 1.0)) for value in rgba[:3])
    return (r, g, b) if rgba[3] else None


def read_shapes(
    link: Element,
    name: str,
    machine: Machine,
    notes: Notes,
    files: Resources,
    place: Callable[[Element], dict[str, Any]],
) -> None:
    """Read the `<visual>`s and `<collision>`s of a link.

    Elements with wrong numbers are refused, unless their kind is left out. `place`: position, orientation and color of
    an element; a color of None is invisible.
    """
    for tag, word in _WORDS.items():
        for element in link.all(tag):
            if tag == "visual" and word in notes.ignore:
                notes.leaves_out(word, name)
                element.skip()
                continue
            try:
                placement = place(element)
                shapes = _read_geometry(element, notes, files, placement)
            except ValueError as error:
                element.skip()
                notes.refuse(word, name, str(error))
                continue
            if tag == "collision":
                machine.collisions += [(name, shape) for shape in shapes]
            elif placement["color"] is not None:
                machine.shapes += [(name, shape) for shape in shapes]


def _read_geometry(element, notes, files, place):
    geometry = element.first("geometry")
    shape = geometry.children[0] if geometry is not None and geometry.children else None
    if shape is None:
        raise ValueError(f"{element.where}<{element.tag}> needs a <geometry>.")
    shape.read = True
    try:
        return _read(shape, notes, files, place)
    except ValueError as error:
        text = str(error)
        raise ValueError(text if text.startswith(shape.where) else f"{shape.where}{text}") from None


def _read(shape, notes, files, place) -> tuple[AbstractShape, ...]:
    length = lambda name: float(_numbers(shape, name, 1)[0])
    match shape.tag:
        case "box":
            return (Box(_numbers(shape, "size"), **place),)
        case "sphere":
            return (Sphere(length("radius"), **place),)
        case "cylinder":
            return (Cylinder(length("radius"), length("length"), **place),)
        case "capsule":
            return capsule(length("radius"), length("length"), **place)
        case "ellipsoid":
            return (Ellipsoid(_numbers(shape, "radii"), **place),)
        case "plane":
            normal = along(_numbers(shape, "normal", default="0 0 1"))
            shape.first("size")
            return (Ground().moved(np.zeros(3), normal).moved(**_placed(place)),)
        case "mesh":
            return _mesh(shape, notes, files, place)
    shape.skip()
    notes.say("Shapes that are not shown: {}.", f"<{shape.tag}>")
    return ()


def _placed(place):
    return {name: place[name] for name in ("position", "orientation")}


def _numbers(shape, name, count=3, default=None):
    """Numbers of a shape, an attribute in URDF and a child in SDF."""
    child = shape.first(name)
    if child is not None:
        return child.numbers(count=count)
    return shape.numbers(shape.attributes.get(name, default) if default else shape.need(name), count)


def _mesh(shape, notes, files, place):
    uri = shape.first("uri")
    name = shape.need("filename") if uri is None else uri.text.strip()
    scale = _numbers(shape, "scale", default="1 1 1")
    file = files.find(name)
    if file is None:
        notes.say("Mesh files are missing, so the picture lacks them; give their folders as package_dirs=: {}.", name)
        return ()
    if importlib.util.find_spec("trimesh") is None:
        notes.say('Meshes need trimesh, so the picture lacks them: pip install "jaxmb[view]".')
        return ()
    try:
        return (Mesh.read(file, scale=scale, **place),)
    except ValueError as error:
        cause = error.__cause__ or error
        notes.say(
            f"Mesh files cannot be read ({type(cause).__name__}: {cause}), so the picture lacks them: {{}}.", name
        )
        return ()
