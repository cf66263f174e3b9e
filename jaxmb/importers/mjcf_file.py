"""MuJoCo's compilation of an MJCF file, without elements for pictures only."""

import os
import warnings
from pathlib import Path
from typing import Any

from .notes import Notes
from .source import file_name, is_text


def compiled(mujoco: Any, source: Any, notes: Notes) -> tuple[Any, str]:
    """MuJoCo's model of a path, a text or an `MjSpec`, and its name in messages.

    Materials, textures and missing meshes are left out, with a note.

    **Raises:** `ValueError` for a file that MuJoCo does not accept, and for a missing mesh that determines an inertia.
    """
    file = file_name(source)
    is_path = isinstance(source, os.PathLike | str) and not is_text(source)
    if is_path and not Path(source).is_file():
        raise ValueError(f"{file} does not exist.")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            spec = _specification(mujoco, source)
            _without_pictures(spec, notes)
            model = _compiled(spec, notes)
            model.names.decode()
    except UnicodeDecodeError:
        raise ValueError(
            f"{file}: names must be in UTF-8, whatever encoding a file declares: save it and its included files as "
            "UTF-8."
        ) from None
    except ValueError as error:
        notes.finish(file)
        raise ValueError(f"{file}: {str(error).strip()}") from None
    for warning in caught:
        notes.say(f"MuJoCo: {warning.message}.")
    return model, file


def _specification(mujoco, source):
    if isinstance(source, mujoco.MjSpec):
        return source.copy()
    return mujoco.MjSpec.from_string(source) if is_text(source) else mujoco.MjSpec.from_file(str(source))


def _compiled(spec, notes):
    """The model; shapes with wrong numbers do not matter if shapes are left out."""
    try:
        return spec.compile()
    except ValueError as error:
        left_out = [shape for shape in spec.geoms if _is_weightless(shape) and _word(shape) in notes.ignore]
        for geom in left_out:
            notes.say("Shapes are not read, since some of them have wrong numbers: {}.", geom.parent.name)
            spec.delete(geom)
        try:
            return spec.compile()
        except ValueError:
            raise error from None


def _word(geom):
    """The word that leaves a shape out."""
    return "collisions" if geom.contype or geom.conaffinity else "pictures"


def _is_weightless(geom):
    """Whether the mass of a body does not come from a shape."""
    body = geom.parent
    return body.name == "world" or body.explicitinertial or geom.mass == 0 or geom.density == 0


def load_mujoco() -> Any:
    """MuJoCo.

    **Raises:** `ImportError` where it is not installed.
    """
    try:
        import mujoco
    except ImportError as error:
        raise ImportError('mjcf needs MuJoCo: pip install "jaxmb[import]"') from error
    return mujoco


def _without_pictures(spec: Any, notes: Notes) -> None:
    for kind in ("geoms", "sites", "tendons", "skins", "flexes"):
        for element in getattr(spec, kind, ()):
            if hasattr(element, "material"):
                element.material = ""
    left_out = [
        f"{len(getattr(spec, kind))} {kind}" for kind in ("materials", "textures", "skins") if getattr(spec, kind)
    ]
    if left_out:
        notes.say(f"Not read, since they are for pictures only: {', '.join(left_out)}.")
    if spec.sensors:
        notes.say(f"Not read, since they do not act on the motion: {len(spec.sensors)} sensors.")
    # Sensors may name elements that are left out below.
    for kind in ("materials", "textures", "skins", "sensors"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    folder = Path(spec.modelfiledir or ".") / (spec.meshdir or "")
    is_missing = lambda item: item.file and not (folder / item.file).exists()
    for field in [item for item in spec.hfields if is_missing(item)]:
        notes.refuse("collisions", field.name, f"The file {field.file!r} of the height field {field.name!r} is missing")
        for geom in [item for item in spec.geoms if item.hfieldname == field.name]:
            spec.delete(geom)
        spec.delete(field)
    missing = {_named(mesh): mesh for mesh in spec.meshes if is_missing(mesh)}
    if missing:
        notes.say(f"Mesh files are missing, so the picture lacks them: {', '.join(sorted(missing))}.")
        _without_meshes(spec, missing, notes)


def _named(mesh):
    return mesh.name or Path(mesh.file).stem


def _without_meshes(spec, missing, notes):
    for geom in list(spec.geoms):
        if geom.meshname not in missing:
            continue
        body = geom.parent
        if not _is_weightless(geom):
            notes.refuse(
                "meshes",
                body.name,
                f"The mass of body {body.name!r} comes from mesh {geom.meshname!r}, whose file is missing: give the "
                "file, or the body an <inertial>",
            )
        spec.delete(geom)
    for mesh in missing.values():
        spec.delete(mesh)
