"""How the tests compile: quickly where many run side by side, and as users do where rounding has to be the same."""

import contextlib
import logging
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator

import jax

# XLA's passes that move things in and out of loops, or reshape them, for the sake of speed.
PASSES = (
    "while-loop-invariant-code-motion",
    "simplify-while-loops",
    "while-loop-constant-sinking",
    "reshape-mover",
    "tree_reduction_rewriter",
    "simplify-conditional",
    "simplify-sorts",
)
# A fifth of the time to compile, which nine tenths of the tests' time was, for three times the time to run.
QUICKLY = (
    "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1"
    f" --xla_cpu_enable_concurrency_optimized_scheduler=false --xla_disable_hlo_passes={','.join(PASSES)}"
    " --xla_backend_extra_options=xla_cpu_disable_slp_vectorizer=true"
)
# Threads of XLA in one process, of several side by side: more of them hand small kernels to each other.
THREADS = {"NPROC": "1"}
# What undoes it in one program; neither the order of its kernels nor how its machine code is cut changes results.
AS_USERS_DO = {
    "xla_cpu_use_fusion_emitters": True,
    "xla_backend_optimization_level": 3,
    "xla_disable_hlo_passes": "",
}


def compile_for_tests():
    """Let the processes that start from here compile quickly: unless told otherwise, or if this XLA has no such way."""
    options = os.environ | THREADS | {"XLA_FLAGS": QUICKLY}
    start = [sys.executable, "-c", "import jax; jax.devices()"]
    if "XLA_FLAGS" not in os.environ and not subprocess.run(start, env=options, capture_output=True).returncode:
        os.environ.update(options)


def jit_as_users_do(function: Callable) -> Callable:
    """`jax.jit` with XLA's own options.

    For comparisons of two programs, a batch and a loop, to less than the tolerance of their solutions: these agree
    where both take the same steps, so where both round alike. Unoptimised programs need not.
    """
    return _jit(function, AS_USERS_DO)


def jit_to_run_long(function: Callable) -> Callable:
    """`jax.jit` for what runs longer than it compiles: quickly still, but half as long or less to run."""
    return _jit(function, {"xla_backend_optimization_level": 1})


def _jit(function, options):
    """With other options than those by which the tests compile, if they do."""
    quickly = os.environ.get("XLA_FLAGS") == QUICKLY
    return jax.jit(function, compiler_options=options if quickly else None)


def jit_quickly(function: Callable) -> Callable:
    """`jax.jit` for what compiles longer than it runs, also in a test that runs alone."""
    options = (option.removeprefix("--").split("=", 1) for option in QUICKLY.split())
    # A single program takes no options of options.
    own = {name: _value(text) for name, text in options if not name.endswith("extra_options")}
    return jax.jit(function, compiler_options=own)


def _value(text):
    return {"false": False, "true": True}.get(text, int(text) if text.isdigit() else text)


class _Names(logging.Handler):
    def __init__(self):
        super().__init__()
        self.names: list[str] = []

    def emit(self, record):
        found = re.match(r"Finished XLA compilation of (?:jit\()?(\w+)", record.getMessage())
        if found:
            self.names.append(found[1])


@contextlib.contextmanager
def compiled() -> Iterator[list[str]]:
    """The names of the programs that are compiled meanwhile, in their order."""
    handler, logger = _Names(), logging.getLogger("jax._src.dispatch")
    logger.addHandler(handler)
    try:
        with jax.log_compiles():
            yield handler.names
    finally:
        logger.removeHandler(handler)
