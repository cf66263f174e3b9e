"""Sources of importers: a path, or the text of a file; and files referred to."""

import dataclasses
import os
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

_DECLARED = re.compile(rb"\s*<\?xml[^>]*?\sencoding\s*=\s*[\"']([\w.:-]+)[\"']")
# Encodings by the first bytes of a file.
_MARKS = ((b"\xef\xbb\xbf", "utf-8-sig"), (b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"))


def is_text(source: Any) -> bool:
    """Whether a source is the text of a file and not a path."""
    return isinstance(source, str) and source.lstrip().startswith("<")


def file_name(source: Any) -> str:
    """The name of a source in messages."""
    if is_text(source):
        return "The text"
    return str(source) if isinstance(source, str | os.PathLike) else type(source).__name__


def text_of(source: str | os.PathLike[str]) -> str:
    """The text of a source; a file is read by the encoding that its first line declares, by default UTF-8.

    **Raises:** `ValueError` for a missing file, or another encoding than declared.
    """
    if is_text(source):
        return str(source)
    if not Path(source).is_file():
        raise ValueError(f"{source} does not exist.")
    content, declared = Path(source).read_bytes(), "utf-8"
    if (declaration := _DECLARED.match(content)) is not None:
        declared = declaration[1].decode()
    declared = next((encoding for mark, encoding in _MARKS if content.startswith(mark)), declared)
    try:
        return content.decode(declared)
    except LookupError:
        raise ValueError(f"{source}:1: the encoding {declared!r} is not known; save the file as UTF-8.") from None
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ValueError(
            f"{source}:{line}: the file is not in the encoding {declared!r}: declare its encoding in the first "
            'line, such as <?xml version="1.0" encoding="ISO-8859-1"?>, or save it as UTF-8.'
        ) from None


@dataclasses.dataclass(frozen=True)
class Resources:
    """Files that a source refers to by `package://`, `model://` or `file://`, or by a path from its folder.

    **Fields:** `folder` of the source, None for a text; `package_dirs`: folders of packages, or with packages.
    """

    folder: Path | None
    package_dirs: tuple[Path, ...]

    @classmethod
    def of(
        cls, source: str | os.PathLike[str], package_dirs: str | os.PathLike[str] | Collection[str | os.PathLike[str]]
    ) -> "Resources":
        """**Raises:** `ValueError` for a package folder that does not exist."""
        given = [package_dirs] if isinstance(package_dirs, str | os.PathLike) else package_dirs
        folders = tuple(Path(folder) for folder in given)
        for folder in folders:
            if not folder.is_dir():
                raise ValueError(f"package_dirs: {folder} is not a folder.")
        return cls(None if is_text(source) else Path(source).resolve().parent, folders)

    def find(self, uri: str) -> Path | None:
        """The file of a URI, or None if there is none.

        A package is searched for in the given folders, then from the source's folder upwards.
        """
        kind, mark, rest = uri.partition("://")
        if not mark:
            return _file((Path() if self.folder is None else self.folder) / uri)
        rest = unquote(rest)
        if kind == "file":
            return _file(Path(rest))
        if kind not in ("package", "model"):
            return None
        package, _, inside = rest.partition("/")
        return next((file for file in (_file(base / inside) for base in self._packages(package)) if file), None)

    def _packages(self, name: str) -> Iterator[Path]:
        """Possible folders of a package."""
        above = () if self.folder is None else (self.folder, *self.folder.parents)
        for folder in (*self.package_dirs, *above):
            yield folder / name
            if folder.name == name or _is_package(folder, name):
                yield folder


def _file(path: Path) -> Path | None:
    try:
        return path if path.is_file() else None
    except (OSError, ValueError):
        # Names that the file system does not accept.
        return None


def _is_package(folder: Path, name: str) -> bool:
    """Whether the manifest of ROS in a folder has this name: the folder's name may differ."""
    manifest = _file(folder / "package.xml")
    if manifest is None:
        return False
    tag = re.search(rb"<name>\s*([^<\s]+)\s*</name>", manifest.read_bytes())
    return tag is not None and tag[1].decode("utf-8", "replace") == name
