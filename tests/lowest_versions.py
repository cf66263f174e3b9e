"""The lowest versions of `pyproject.toml` in an environment of their own, and the tests in it.

`python tests/lowest_versions.py ENVIRONMENT [options of pytest]` makes the environment in a folder, or takes one that
it made before, installs exactly the lower bounds of the dependencies and of the extra `test`, and runs pytest on all
but the tests that run the linter and the type checker.
"""

import argparse
import subprocess
import sys
import tomllib
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
# What pyright and ruff find depends on the versions of the tools and on the types that libraries declare, not on what
# the package can run with; so these and their tests are left out.
CHECKERS = ("pyright", "ruff")
THEIR_TESTS = "tests/package/test_quality.py"


def lowest(requirement: Requirement) -> str:
    """The lower bound of a requirement, as one of exactly this version."""
    (bound,) = (spec.version for spec in requirement.specifier if spec.operator == ">=")
    return f"{requirement.name}=={bound}"


def requirements() -> list[str]:
    """The lowest versions of all that the package and its tests ask for, from `pyproject.toml`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {name: list(map(Requirement, lines)) for name, lines in project["optional-dependencies"].items()}
    (own,) = (line for line in extras["test"] if line.name == project["name"])
    tools = [line for line in extras["test"] if line.name not in (own.name, *CHECKERS)]
    features = [line for name in sorted(own.extras) for line in extras[name]]
    return list(map(lowest, [*map(Requirement, project["dependencies"]), *features, *tools]))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", type=Path)
    known, options = parser.parse_known_args()
    python = known.environment / "bin" / "python"
    if not python.exists():
        subprocess.run([sys.executable, "-m", "venv", known.environment], check=True)
    subprocess.run([python, "-m", "pip", "install", "--quiet", *requirements()], check=True)
    return subprocess.run([python, "-m", "pytest", f"--ignore={THEIR_TESTS}", *options], cwd=ROOT).returncode


if __name__ == "__main__":
    sys.exit(main())
