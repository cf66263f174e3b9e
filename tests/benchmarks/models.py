"""Models of other programs: how many can be imported, and why the others are refused.

Run it with `python tests/benchmarks/models.py [folder or package ...]`, by default on the packages of the extra
`test-models` that are installed, whose files alone are needed: `pip install --no-deps dm_control`. A file counts if it
is a whole model: MJCF with bodies that MuJoCo itself loads, or would if no file of a mesh or picture were missing, and
URDF and SDF without macros. URDF whose root link alone could move has a free root. A refused file is listed once under
each of its reasons, without the names in them.

Options: `--ignore` with words, by default those of what only touches or is only seen, and "fluid"; `--files` lists the
refused files; `--compile N` also compiles N of the scenes, evenly spaced; `--seconds` that a file may take.
"""

import argparse
import importlib.metadata
import multiprocessing
import re
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path

PACKAGES = (
    "brax",
    "dm_control",
    "example-robot-data",
    "gymnasium",
    "gymnasium-robotics",
    "mujoco-core",
    "myosuite",
    "newton",
    "playground",
    "pybullet",
    "robosuite",
)
IGNORED = "collisions fluid limits pictures"
# Names, numbers and places in messages.
SPECIFIC = re.compile(r"'[^']*'|\"[^\"]*\"|[-+]?\d[\d.e+-]*|\[[^\]]*\]|\([^)]*, …\)|\S*/\S+:")


def files_of(where):
    """The files of a folder or of an installed package."""
    if Path(where).is_dir():
        found = Path(where).rglob("*")
    else:
        found = (Path(str(own.locate())) for own in importlib.metadata.files(where) or ())
    wanted = (own.resolve() for own in found if own.suffix.lower() in (".xml", ".urdf", ".sdf"))
    # A thousand objects of pybullet are one body each, all alike.
    return sorted(own for own in wanted if own.is_file() and "random_urdfs" not in own.parts)


def format_of(path):
    """The format of a file by its root, None for what is no whole model."""
    text = re.sub(r"<!--.*?-->|<\?.*?\?>", "", path.read_bytes().decode("utf-8", "replace"), flags=re.DOTALL)
    tag = re.search(r"<([A-Za-z]\w*)", text)
    root = "" if tag is None else tag[1]
    if root == "mujoco":
        return "mjcf" if _loads(path) else None
    if root == "robot":
        return "urdf" if "<link" in text and "<xacro:" not in text and "$(" not in text else None
    return "sdf" if root == "sdf" and "<model" in text else None


def _loads(path):
    """Whether MuJoCo loads a file, or would if a file of a mesh or picture were not missing."""
    import mujoco

    try:
        return mujoco.MjModel.from_xml_path(str(path)).nbody > 1
    except ValueError as error:
        return bool(re.search(r"^Error: Error opening file|resource not found", str(error)))


def survey(path, ignored, compiles):
    """Format, reasons of refusal, and notes of a file."""
    from jaxmb import importers

    kind = format_of(path)
    if kind is None:
        return None, [], []
    try:
        try:
            model = getattr(importers, kind)(path, ignore=ignored)
        except ValueError as error:
            if kind != "urdf" or "There is no moving link" not in str(error):
                raise
            model = importers.urdf(path, ignore=ignored, base="free")
        if compiles:
            model.scene.compile()
        return kind, [], list(model.notes)
    except ValueError as error:
        lines = str(error).split("\n- ")
        return kind, [_reason(line) for line in lines[1:] or lines], []
    except Exception as error:
        return kind, [f"CRASH: {type(error).__name__}: {error}"], []


def _reason(line):
    return SPECIFIC.sub("…", line.replace("\n", " ")).strip()


def _work(pipe, ignored):
    import jax

    jax.config.update("jax_enable_x64", True)
    while True:
        path, compiles = pipe.recv()
        pipe.send(survey(path, ignored, compiles))


class Worker:
    """A process that surveys files one after the other, and is replaced where one takes too long."""

    def __init__(self, ignored, seconds):
        self.ignored, self.seconds, self.process = ignored, seconds, None

    def __call__(self, path, compiles=False):
        if self.process is None:
            context = multiprocessing.get_context("spawn")
            self.pipe, other = context.Pipe()
            self.process = context.Process(target=_work, args=(other, self.ignored), daemon=True)
            self.process.start()
            other.close()
            self.pipe.send((Path(__file__), False))
            self.pipe.recv()
        self.pipe.send((path, compiles))
        try:
            if self.pipe.poll(self.seconds):
                return self.pipe.recv()
            said = f"CRASH: it takes more than {self.seconds:g} s"
        except EOFError:
            said = "CRASH: the process died"
        self.process.kill()
        self.process.join()
        self.process = None
        return "unknown", [said], []


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("where", nargs="*")
    parser.add_argument("--ignore", default=IGNORED)
    parser.add_argument("--files", action="store_true")
    parser.add_argument("--compile", type=int, default=0)
    parser.add_argument("--seconds", type=float, default=60.0)
    given = parser.parse_args()
    worker = Worker(given.ignore.split(), given.seconds)
    totals, imported, reasons, at = Counter(), defaultdict(list), defaultdict(list), {}
    for where in given.where or PACKAGES:
        try:
            files = files_of(where)
        except importlib.metadata.PackageNotFoundError:
            print(f"{where} is not installed: pip install --no-deps {where}")
            continue
        for path in files:
            start = time.perf_counter()
            kind, refused, _ = worker(path)
            at[path] = time.perf_counter() - start
            if kind is None:
                continue
            totals[where] += 1
            for reason in dict.fromkeys(refused):
                reasons[reason].append(path)
            if not refused:
                imported[where].append(path)
        print(f"{where:20} {len(imported[where]):4} of {totals[where]:4} models", flush=True)
    everything = [path for files in imported.values() for path in files]
    print(f"{'in all':20} {len(everything):4} of {totals.total():4} models\n")
    for reason, files in sorted(reasons.items(), key=lambda item: -len(item[1])):
        print(f"{len(files):4}  {reason[:200]}")
        for path in files if given.files else ():
            print(f"      {path}")
    if given.compile:
        step = max(1, len(everything) // given.compile)
        for path in everything[::step]:
            _, refused, _ = worker(path, True)
            print(f"compiled {path}" if not refused else f"NOT COMPILED {path}: {refused[0]}", flush=True)
    sys.exit(any(reason.startswith("CRASH") for reason in reasons))


if __name__ == "__main__":
    main()
