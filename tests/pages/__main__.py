"""Build the pages of names, topics and notebooks, and follow their links: `python -m tests.pages [FOLDER]`, from the
checkout.

A warning of Sphinx is an error. Links to other sites are not followed.
"""

import re
import sys
from pathlib import Path
from urllib.parse import unquote

ROOT = Path(__file__).parents[2]
LINK, PLACE = re.compile(r'(?:href|src)="([^"]*)"'), re.compile(r'\bid="([^"]*)"')
ELSEWHERE = re.compile(r"[a-z]+:|//")


def broken(folder: Path) -> list[str]:
    """Links within the pages of a folder to a file or a place that is not there."""
    texts = {path.resolve(): path.read_text(encoding="utf-8") for path in folder.rglob("*.html")}
    places = {path: set(PLACE.findall(text)) for path, text in texts.items()}
    out = []
    for path, text in texts.items():
        for link in set(LINK.findall(text)):
            name, _, place = unquote(link).partition("#")
            if ELSEWHERE.match(link):
                continue
            target = (path.parent / name.partition("?")[0]).resolve() if name else path
            if not target.exists() or (place and target in places and place not in places[target]):
                out.append(f"{path.relative_to(folder.resolve())}: {link}")
    return sorted(out)


def main(folder: str = "jaxmb-output/pages") -> int:
    # Of the extra `docs`.
    from sphinx.cmd.build import main as build

    failed = build(["-q", "-W", "--keep-going", "-E", "-c", str(ROOT / "tests" / "pages"), str(ROOT), folder])
    missing = broken(Path(folder))
    print(*(f"A link leads nowhere: {link}" for link in missing), Path(folder) / "tests/pages/index.html", sep="\n")
    return failed or bool(missing)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
