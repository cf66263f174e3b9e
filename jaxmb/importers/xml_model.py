"""The model of a machine, after all of its URDF or SDF has been read."""

from collections.abc import Collection

from .build import build_scene
from .description import Machine
from .model import ImportedModel
from .notes import Notes
from .xml_tree import Element


def model_of(root: Element, machine: Machine, notes: Notes, file: str, effectless: Collection[str]) -> ImportedModel:
    """The model; its notes also name unread elements. `effectless`: tags without effect on the motion.

    **Raises:** `ValueError` that lists all refused elements.
    """
    if machine.collisions:
        notes.refuse("collisions", "", "Links have shapes for collisions")
    unread = list(root.unread())
    for element in unread:
        if element.tag not in effectless:
            notes.say(f"<{element.tag}> is not read; lines: {{}}.", element.line)
    listed = sorted({element.tag for element in unread} & set(effectless))
    if listed:
        notes.say(f"Not read, since they do not act on the motion: {', '.join(f'<{tag}>' for tag in listed)}.")
    built = build_scene(machine, notes)
    coordinates = {joint: name for joint, name in built.coordinates.items() if name is not None}
    sentences = notes.finish(file)
    return ImportedModel(
        machine.name,
        built.scene,
        tuple(sentences),
        coordinates,
        built.controls,
        shapes=built.shapes,
        collision_shapes=built.collision_shapes,
        named=sentences,
    )
