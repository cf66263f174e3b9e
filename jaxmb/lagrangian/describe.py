"""What a system from a Lagrangian is made of, in words."""

from typing import TYPE_CHECKING

from ..system.describe import Description, constraints_left_out, count_independent, count_rows, shorten

if TYPE_CHECKING:
    from .system import LagrangianSystem


def describe(system: "LagrangianSystem") -> Description:
    """Describe a system; from its static structure alone, so it works on traced systems as well."""
    kind = "rates of the coordinates" if system.kinematics.identity else f"of a {type(system.kinematics).__name__}"
    facts = [
        ("system", f"of a Lagrangian, {system.nq} coordinates: {shorten(system.coordinates)}"),
        ("velocities", f"{system.nu}, {kind}"),
        ("constraint rows", count_rows(system)),
        ("degrees of freedom", str(system.nu - system.velocity_rank)),
        ("independent", count_independent(system)),
        ("equations", type(system.equations).__name__),
    ]
    if system.parameters:
        facts.append(("parameters", shorten(system.parameters)))
    sizes = zip(system.constraints, system.sizes, strict=True)
    tables = {
        "constraints": tuple((type(c).__name__, c.name, f"{n} row{'s' * (n > 1)}") for c, n in sizes),
        "beyond d'Alembert's principle": tuple((type(law).__name__, law.constraint, "") for law in system.nonideal),
    }
    return Description(tuple(facts), tables, {"left out": tuple(_left_out(system))})


def _left_out(system: "LagrangianSystem") -> list[str]:
    out = constraints_left_out(system)
    if system.diagonal:
        out.append("diagonal mass matrix: no factorisation")
    if system.applied is None:
        out.append("no forces besides those of the Lagrangian")
    return out
