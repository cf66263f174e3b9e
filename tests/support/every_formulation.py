"""Every formulation, in each of its forms."""

from jaxmb.formulations import Multipliers, NullSpace, Partitioned, Poincare, UdwadiaKalaba

FORMULATIONS = {
    "partitioned": Partitioned(),
    "multipliers": Multipliers(),
    "null_space": NullSpace(),
    "poincare": Poincare(),
    "moore_penrose": UdwadiaKalaba(),
    "inverses": UdwadiaKalaba("inverses"),
    "singular_mass": UdwadiaKalaba("singular_mass"),
}
