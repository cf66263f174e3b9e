"""Do the short tests find faults? A fault below is a wrong sign or factor, or a missing term, in a copy of the package.

    python tests/benchmarks/seeded_faults.py [WORD ...]

runs the short tests on every copy, those of the fault's folder first, and prints the first test that fails, for all
faults or those whose file or line contains a word. It exits with 1 if a fault is not found.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[2]
# File in the package, code, code with the fault.
FAULTS = [
    ("parts/forces.py", "* d - self.damping * along", "* d + self.damping * along"),
    ("parts/forces.py", "- 2 * self.free_length * norm(d)", "- self.free_length * norm(d)"),
    ("parts/contact.py", "* depth**2.5 / 2.5", "* depth**2.5 / 1.5"),
    ("parts/contact.py", "-load * gradient - resistance * normal", "-load * gradient + resistance * normal"),
    ("parts/tyre.py", "-slip - self._speed(rolling)", "-slip + self._speed(rolling)"),
    ("parts/spatial/rolling.py", "slip = slip - self.spin", "slip = slip + self.spin"),
    ("parts/terrain.py", ".set(-slope)", ".set(slope)"),
    ("parts/actuators.py", "* control + jnp.dot(self.bias, terms)", "* control - jnp.dot(self.bias, terms)"),
    ("parts/dry_friction.py", "else slip - self.speed", "else slip + self.speed"),
    ("parts/unilateral.py", "jnp.dot(d, d)) / (2 * self.length)", "jnp.dot(d, d)) / self.length"),
    ("parts/spatial/bodies.py", "(3 * radius**2 + length**2) / 12", "(radius**2 + length**2) / 12"),
    ("manifold/baumgarte.py", "shift = shift + self.rate**2 *", "shift = shift + self.rate *"),
    ("manifold/constraints.py", "laws.remembered(at, multipliers)) + at.constraint", "multipliers) + at.constraint"),
    ("manifold/constraints.py", "return along.with_(u=along.u + here", "return along.with_(u=along.u - here"),
    ("manifold/impulse.py", "return t + (moved - fixed)", "return t"),
    ("linalg/elimination.py", "-(pushed @ factor.null_space)", "pushed @ factor.null_space"),
    ("linalg/block_elimination.py", "*(-right[i, :, k] * solved", "*(right[i, :, k] * solved"),
    ("linalg/newton.py", "size * jnp.maximum(shrinks, rate)), k + 1", "size * rate), k + 1"),
    ("solvers/adams.py", "+ of.h * of.last * (second.f - neighbours[1])", "+ of.last * (second.f - neighbours[1])"),
    ("solvers/adams_steps.py", "return last - change,", "return last + change,"),
    ("solvers/mesh.py", "lw = lw + table[0]", "lw = lw"),
    ("solvers/mesh.py", "jnp.where(is_last, c, 0)", "jnp.where(is_last, 0, c)"),
    ("solvers/_formulas.py", "slope = means / values - curvature", "slope = means / values + curvature"),
    ("solvers/hermite.py", "used.size), dtype) @ (1 / (formula.end", "used.size), dtype) @ (2 / (formula.end"),
]


def first_failure(file: str, code: str, wrong: str) -> str | None:
    """The name of the first short test that fails with the fault; None if all pass."""
    with tempfile.TemporaryDirectory() as place:
        for name in ("jaxmb", "tests", "notebooks"):
            shutil.copytree(ROOT / name, Path(place, name), ignore=shutil.ignore_patterns("__pycache__"))
        for name in ("pyproject.toml", "README.md"):
            shutil.copy(ROOT / name, place)
        path = Path(place, "jaxmb", file)
        text = path.read_text()
        if text.count(code) != 1:
            raise ValueError(f"{file} has {code!r} {text.count(code)} times, not once.")
        path.write_text(text.replace(code, wrong))
        for tests in (f"tests/{file.split('/')[0]}", "tests"):
            command = [sys.executable, "-m", "pytest", "-x", "-q", "-n", "1", tests, f"--ignore={place}/tests/package"]
            environment = os.environ | {"PYTHONPATH": place}
            out = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True).stdout
            failed = re.search(r"^(?:FAILED|ERROR) (\S.*?)(?: - |$)", out, re.MULTILINE)
            if failed:
                return failed.group(1)
        return None


def main(words: list[str]) -> int:
    missed = 0
    for fault in FAULTS:
        if words and not any(word in " ".join(fault) for word in words):
            continue
        began = time.perf_counter()
        found = first_failure(*fault)
        missed += found is None
        print(f"{fault[0]}: {fault[1]} → {fault[2]}: {found or 'NOT FOUND'} ({time.perf_counter() - began:.0f} s)")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
