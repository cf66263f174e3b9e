"""Shapes of URDF and SDF, elements that have the same names and meanings in both."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

from ..parts.shapes import AbstractShape, Box, Color, Cylinder, Ellipsoid, Ground, Mesh, Sphere, along, capsule
from .notes import Notes
from .xml_tree import Element


def color_of(rgba: Any) -> Color | None:
    """Red, green and blue from 0 to 255 of numbers in [0, 1]; None for what is not seen."""
    r, g, b = (round(255 * float(value)) for value in rgba[:3])
    return (r, g, b) if rgba[3] else None


def read_geometry(element: Element, notes: Notes, **place: Any) -> tuple[AbstractShape, ...]:
    """The shapes of a `<visual>` or `<collision>`; `place`: their position, orientation and color."""
    geometry = element.first("geometry")
    shape = geometry.children[0] if geometry is not None and geometry.children else None
    if shape is None:
        raise ValueError(f"{element.where}<{element.tag}> needs a <geometry>.")
    shape.read = True
    try:
        return _read(shape, notes, place)
    except ValueError as error:
        said = str(error)
        raise ValueError(said if said.startswith(shape.where) else f"{shape.where}{said}") from None


def _read(shape, notes, place):
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
            return _mesh(shape, notes, place)
    for child in shape.children:
        child.read = True
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


def _mesh(shape, notes, place):
    uri = shape.first("uri")
    file = shape.need("filename") if uri is None else uri.text.strip()
    scale = _numbers(shape, "scale", default="1 1 1")
    if not Path(file).is_file():
        notes.say("Mesh files are missing, so the picture lacks them: {}.", file)
        return ()
    if importlib.util.find_spec("trimesh") is None:
        notes.say('Meshes need trimesh, so the picture lacks them: pip install "jaxmb[view]".')
        return ()
    return (Mesh.read(file, scale=scale, **place),)
