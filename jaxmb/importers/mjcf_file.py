"""MuJoCo's compilation of an MJCF file, without what only pictures need."""

import os
from pathlib import Path
from typing import Any

from .notes import Notes
from .source import file_name, is_text


def compiled(source: str | os.PathLike[str], notes: Notes) -> tuple[Any, str]:
    """MuJoCo's model of a file, and what messages call the file.

    Materials and textures, and meshes that are missing, are left out, and `notes` say so.

    **Raises:** `ValueError` for a file that MuJoCo does not accept, and for a missing mesh that an inertia comes from.
    """
    mujoco = _mujoco()
    file = file_name(source)
    if not is_text(source) and not Path(source).exists():
        raise ValueError(f"{file} does not exist.")
    try:
        spec = mujoco.MjSpec.from_string(source) if is_text(source) else mujoco.MjSpec.from_file(str(source))
        _without_pictures(spec, notes)
        return spec.compile(), file
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def _mujoco():
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
    left_out = [f"{len(getattr(spec, kind))} {kind}" for kind in ("materials", "textures", "skins") if getattr(spec, kind)]
    if left_out:
        notes.say(f"Not read, since they are for pictures only: {', '.join(left_out)}.")
    for kind in ("materials", "textures", "skins"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)
    folder = Path(spec.modelfiledir or ".") / (spec.meshdir or "")
    is_missing = lambda mesh: mesh.file and not (folder / mesh.file).exists()
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
        weighs = not (geom.mass == 0 or geom.density == 0)
        if body.name != "world" and weighs and not body.explicitinertial:
            notes.refuse(
                "meshes",
                body.name,
                f"The mass of body {body.name!r} comes from mesh {geom.meshname!r}, whose file is missing: give the file, "
                "or the body an <inertial>",
            )
        spec.delete(geom)
    for mesh in missing.values():
        spec.delete(mesh)
