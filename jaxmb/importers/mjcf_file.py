"""MuJoCo's compilation of an MJCF file, without what only pictures need."""

import os
from pathlib import Path
from typing import Any

from .source import file_name, is_text


def compiled(source: str | os.PathLike[str]) -> tuple[Any, str, list[str]]:
    """MuJoCo's model of a file, what messages call the file, and sentences on what was left out.

    Materials and textures, and meshes that are missing, are left out.

    **Raises:** `ValueError` for a file that MuJoCo does not accept, and for a missing mesh that an inertia comes from.
    """
    mujoco = _mujoco()
    file = file_name(source)
    if not is_text(source) and not Path(source).exists():
        raise ValueError(f"{file} does not exist.")
    try:
        spec = mujoco.MjSpec.from_string(source) if is_text(source) else mujoco.MjSpec.from_file(str(source))
        said = _without_pictures(mujoco, spec, file)
        return spec.compile(), file, said
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from None


def _mujoco():
    try:
        import mujoco
    except ImportError as error:
        raise ImportError('mjcf needs MuJoCo: pip install "jaxmb[import]"') from error
    return mujoco


def _without_pictures(mujoco: Any, spec: Any, file: str) -> list[str]:
    said = []
    for kind in ("geoms", "sites", "tendons", "skins", "flexes"):
        for element in getattr(spec, kind, ()):
            if hasattr(element, "material"):
                element.material = ""
    for kind in ("materials", "textures", "skins"):
        elements = list(getattr(spec, kind))
        if elements:
            said.append(f"{kind.capitalize()} are left out: {len(elements)}.")
        for element in elements:
            spec.delete(element)
    folder = Path(spec.modelfiledir or ".") / (spec.meshdir or "")
    missing = {mesh.name or Path(mesh.file).stem for mesh in spec.meshes if mesh.file and not (folder / mesh.file).exists()}
    if missing:
        _without_meshes(mujoco, spec, missing, file)
        said.append(f"Mesh files are missing, so the picture lacks them: {', '.join(sorted(missing))}.")
    return said


def _without_meshes(mujoco, spec, missing, file):
    for geom in list(spec.geoms):
        if geom.meshname not in missing:
            continue
        body = geom.parent
        weighs = not (geom.mass == 0 or geom.density == 0)
        if body.name != "world" and weighs and not body.explicitinertial:
            raise ValueError(
                f"the inertia of body {body.name!r} comes from mesh {geom.meshname!r}, whose file is missing; give the "
                "file, or the body an <inertial>."
            )
        spec.delete(geom)
    for mesh in list(spec.meshes):
        if (mesh.name or Path(mesh.file).stem) in missing:
            spec.delete(mesh)
