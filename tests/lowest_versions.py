"""The lowest versions of `pyproject.toml` in an environment of their own, and the tests in it.

`python tests/lowest_versions.py ENVIRONMENT [options of pytest]` makes the environment in a folder, or takes one that
it made before, installs exactly the lower bounds of the dependencies and of the extras that tests need, and runs
pytest.
"""

import argparse
import subprocess
import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
# What the tests need beside the dependencies; `test` itself names tools that need not be old.
EXTRAS = ("plot", "import", "view", "studies")
TOOLS = ("pytest", "pytest-xdist", "filelock", "pandas")


def lowest(requirement: Requirement) -> str:
    """The lower bound of a requirement, as one of exactly this version."""
    (bound,) = (spec.version for spec in requirement.specifier if spec.operator == ">=")
    return f"{requirement.name}=={bound}"


def requirements() -> list[str]:
    """The lowest versions of all that the package asks for, from `pyproject.toml`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needed = [*project["dependencies"], *(line for name in EXTRAS for line in extras[name])]
    tools = [line for line in map(Requirement, extras["test"]) if line.name in TOOLS]
    return [*(lowest(Requirement(line)) for line in needed), *map(lowest, tools)]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", type=Path)
    known, options = parser.parse_known_args()
    python = known.environment / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", known.environment], check=True)
    subprocess.run([python, "-m", "pip", "install", "--quiet", *requirements()], check=True)
    return subprocess.run([python, "-m", "pytest", *options], cwd=ROOT).returncode


if __name__ == "__main__":
    sys.exit(main())
