"""Versions of other packages that compute wrong numbers."""

import importlib.metadata
import warnings

# For each package and version, the fault and the cure.
FAULTS = {
    (
        "jaxlib",
        "0.10.2",
    ): "on CPUs, products of small matrices with more than 16384 rows at once are wrong, as in "
    'large batches: pip install "jax!=0.10.2" "jaxlib!=0.10.2"',
    (
        "mujoco",
        "4.0.0",
    ): "motions with constraints are wrong where MuJoCo's Jacobian is sparse, as from 60 velocities "
    'on, while imports are right: pip install "mujoco!=4.0.0"',
}


def fault_of(package: str) -> str | None:
    """The fault of the installed version of a package, `"jaxlib 0.10.2: …"`; None if none is known."""
    try:
        version = importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
    fault = FAULTS.get((package, version))
    return None if fault is None else f"{package} {version}: {fault}"


def warn_of_jaxlib() -> None:
    """Warn if the numbers of this package may be wrong."""
    fault = fault_of("jaxlib")
    if fault is not None:
        warnings.warn(f"{fault}.", stacklevel=2)
