"""The linear equations of small motions: eigenvalues, modes and frequency responses."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from ..._arguments import real_array
from ..._pictured import picture
from ..._printed import preformatted
from ..._types import Scalar, State, VectorLike
from ...linalg.arrays import is_traced
from ...manifold.orthogonal_projection import project_normalized
from ...system import AbstractSystem
from .eigen import eigen

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# A column of A below this fraction of the largest, in units of the states' sizes, counts as zero.
_NO_EFFECT = 1e-10
# Units of rounding of A that printed eigenvalues suppress.
_ROUNDING = 10


class Mode(eqx.Module):
    """A mode of a linearised motion: `x(t) = x₀ + Re(amplitude e^{λ t} shape)`.

    **Fields:** `eigenvalue` λ [1/s]; `q`, `u` and `z`: the complex shape in all coordinates (nq,), velocities (nu,) and
    internal states (nz,), with a largest displacement of one in units of the system's size; `system`, `state`, `t`.
    """

    eigenvalue: Complex[Array, ""]
    q: Complex[Array, "nq"]
    u: Complex[Array, "nu"]
    z: Complex[Array, "nz"]
    system: AbstractSystem
    state: State
    t: Array

    def at(self, phase: Scalar, amplitude: Scalar) -> State:
        """The state on the constraints nearest to the mode at a phase [rad], for pictures and simulations.

        **Arguments:** `amplitude`: of the largest displacement, in units of the system's size, or in radians.
        """
        dtype, given = self.state.q.dtype, (("phase", phase), ("amplitude", amplitude))
        phase, amplitude = (jnp.asarray(real_array(f"Mode.at: {name}", x, dtype)) for name, x in given)
        shown = lambda shape: amplitude * (jnp.cos(phase) * shape.real - jnp.sin(phase) * shape.imag)
        z = None if self.state.z is None else self.state.z + shown(self.z)
        displaced = State(self.state.q + shown(self.q), self.state.u + shown(self.u), z)
        return project_normalized(self.system, self.t, displaced)


class Linearisation(eqx.Module):
    """`ż = A z + B w`, `y = C z + D w`: small changes of states z, inputs w and outputs y. `print` shows its modes.

    `print` shows the real or imaginary part of an eigenvalue as 0 if it is below ten units of rounding of A, in units
    of the states' sizes, times the eigenvalue's condition. The condition is large for the two zero eigenvalues of a
    coordinate without restoring force, which are computed as about 1e-8 of the largest; parts above ten times this are
    never shown as 0. `eigenvalues` are the computed values.

    ```python
    about_rest = jaxmb.linearise(system, jaxmb.equilibrium(system), outputs=["bar.angle"])
    print(about_rest)  # Its modes: frequencies, damping and shapes.
    about_rest.A, about_rest.C, about_rest.states
    about_rest.plot().savefig("eigenvalues.png")
    ```

    **Fields:**

    - `A` (k, k), `B` (k, inputs), `C` (outputs, k), `D` (outputs, inputs), in SI units.
    - `states`, `inputs`, `outputs`: their names. The states are first `coordinates` coordinates, then rates, then
        internal states.
    - `basis` (nq + nu + nz, k): the changes of all coordinates, velocities and internal states with each of `states`;
        `system`, `state`, `t`.
    """

    A: Float[Array, "k k"]
    B: Float[Array, "k i"]
    C: Float[Array, "o k"]
    D: Float[Array, "o i"]
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)
    coordinates: int = eqx.field(static=True)
    basis: Float[Array, "n k"]
    system: AbstractSystem
    state: State
    t: Array

    @property
    def eigenvalues(self) -> Complex[Array, "k"]:
        """Eigenvalues of A [1/s] in order of their sizes. Simple eigenvalues are differentiable; derivatives of others
        are not finite.
        """
        return _spectrum(self)[0]

    @property
    def vectors(self) -> Complex[Array, "k k"]:
        """Eigenvectors as columns, in the states; see `Mode` for their size."""
        return _spectrum(self)[1]

    @property
    def frequencies(self) -> Float[Array, "k"]:
        """`|λ|` of every eigenvalue [rad/s], the natural frequency of a vibration without its damping."""
        return _size(self.eigenvalues)

    @property
    def damping_ratios(self) -> Float[Array, "k"]:
        """`−Re λ / |λ|` of every eigenvalue; zero for a zero eigenvalue."""
        values = self.eigenvalues
        size = _size(values)
        return jnp.where(size > 0, -values.real / jnp.where(size > 0, size, 1.0), 0.0)

    @property
    def ignorable(self) -> Bool[Array, "k"]:
        """Whether each state is ignorable: without effect except on ignorable states. Their eigenvalues are zero."""
        return ~_effective(self)

    def mode(self, k: int) -> Mode:
        """The mode of the k-th eigenvalue.

        **Raises:** `ValueError` for a number out of range.
        """
        count = len(self.states)
        if isinstance(k, bool) or not isinstance(k, int | np.integer) or not -count <= k < count:
            raise ValueError(f"There are {count} modes, numbered from 0, got {k!r}.")
        values, vectors = _spectrum(self)
        shape = self.basis.astype(vectors.dtype) @ vectors[:, k]
        q, u, z = jnp.split(shape, [self.system.nq, self.system.nq + self.system.nu])
        return Mode(values[k], q, u, z, self.system, self.state, self.t)

    def frequency_response(self, omega: ArrayLike) -> Complex[Array, "frequencies o i"]:
        """`C (iω − A)⁻¹ B + D` at angular frequencies [rad/s], shape (frequencies, outputs, inputs).

        **Raises:** `ValueError` for frequencies that are not a vector of real numbers, and without inputs or outputs.
        """
        if not self.inputs or not self.outputs:
            raise ValueError("A frequency response needs inputs and outputs: linearise(..., inputs=, outputs=).")
        omega = jnp.asarray(real_array("omega", omega, self.A.dtype, None))
        if omega.ndim != 1:
            raise ValueError(f"omega must be a vector of angular frequencies, got shape {omega.shape}.")
        return _response(self, omega)

    def response(self, z0: ArrayLike, ts: VectorLike) -> Float[Array, "times k"]:
        """The states at times [s] after initial changes z0 (k,), `exp(A t) z0`, without inputs.

        **Raises:** `ValueError` for arguments of another shape.
        """
        dtype, count = self.A.dtype, len(self.states)
        start, times = (
            jnp.asarray(real_array("z0", z0, dtype, ((count,),))),
            jnp.asarray(real_array("ts", ts, dtype, None)),
        )
        if times.ndim != 1:
            raise ValueError(f"ts must be a vector of times, got shape {times.shape}.")
        return jax.vmap(lambda t: jax.scipy.linalg.expm(self.A * t) @ start)(times)

    def plot(
        self, inputs: str | Sequence[str] = (), outputs: str | Sequence[str] = (), *, omega: ArrayLike | None = None
    ) -> "Figure":
        """Plot frequency responses, Bode's diagram; of a system without inputs or outputs its eigenvalues.

        **Arguments:** `inputs`, `outputs`: one or several names, default all; `omega`: angular frequencies [rad/s],
        default from a tenth of the smallest to ten times the largest eigenvalue.

        **Returns:** a matplotlib `Figure` of gains, in SI units, and phases [°]; or of the complex plane, with lines of
        constant damping ratios.

        **Raises:** `ValueError` for unknown names, more than eight responses and a batch; `ImportError` without
        matplotlib.
        """
        return picture("small_motions.linearisation", self, inputs, outputs, omega)

    def to_scipy(self) -> Any:
        """These equations as a `scipy.signal.StateSpace`, without names.

        **Raises:** `ImportError` without SciPy.
        """
        try:
            from scipy.signal import StateSpace
        except ImportError as error:
            raise ImportError('to_scipy needs SciPy; install it with: pip install "jaxmb[studies]"') from error
        return StateSpace(*map(np.asarray, (self.A, self.B, self.C, self.D)))

    def to_control(self) -> Any:
        """These equations as a `control.StateSpace` of python-control; names have underscores for dots: `motor_torque`.

        **Raises:** `ImportError` without python-control.
        """
        try:
            from control import ss
        except ImportError as error:
            raise ImportError("to_control needs python-control; install it with: pip install control") from error
        names_by_kind = {"states": self.states, "inputs": self.inputs, "outputs": self.outputs}
        names = {kind: [name.replace(".", "_") for name in of_kind] for kind, of_kind in names_by_kind.items()}
        return ss(*map(np.asarray, (self.A, self.B, self.C, self.D)), **names)

    def __repr__(self) -> str:
        numbers = (len(self.states), len(self.inputs), len(self.outputs))
        return "Linearisation: {} states, {} inputs, {} outputs".format(*numbers)

    def _repr_html_(self) -> str:
        return preformatted(self)

    def __str__(self) -> str:
        if is_traced(self.A) or self.A.ndim != 2:
            return repr(self)
        values, shapes = _without_rounding(self)
        shares = np.abs(shapes)
        lines = [f"{'mode':>4}  {'eigenvalue [1/s]':>24}  {'[rad/s]':>9}  {'damping':>8}  largest states"]
        for k, value in enumerate(values):
            if value.imag < 0:
                continue
            size = abs(value)
            # Subtracted from zero, so that zero damping has no sign.
            ratio = (0.0 - value.real) / size if size > 0 else 0.0
            text = f"{value.real:.5g}" + (f" ± {value.imag:.5g}i" if value.imag > 0 else "")
            # A change of speed alone displaces nothing at first.
            displaced = np.any(shares[: self.coordinates, k])
            weights = shares[: self.coordinates, k] if displaced else shares[:, k]
            largest = [self.states[j] for j in np.argsort(-weights)[:3] if weights[j] > 0.05 * weights.max()]
            lines.append(f"{k:>4}  {text:>24}  {size:>9.5g}  {ratio:>8.4f}  {', '.join(largest)}")
        return "\n".join(lines)


def _without_rounding(linear):
    """Eigenvalues with zero for values that rounding explains, and their vectors in units of the states' sizes."""
    (values, vectors), widths = _spectrum(linear), np.asarray(_widths(linear))
    shapes = np.asarray(vectors) * widths[:, None]
    if not np.all(np.isfinite(shapes)):
        return np.asarray(values), shapes
    # The norms of the left eigenvectors w with wᵀ v = 1 and |v| = 1: a change dA moves λ by |w| |dA| at most.
    conditions = np.linalg.norm(np.linalg.pinv(shapes / np.linalg.norm(shapes, axis=0)), axis=1)
    largest, eps = np.linalg.norm(np.asarray(linear.A) * widths[:, None] / widths), np.finfo(widths.dtype).eps
    least = _ROUNDING * largest * np.minimum(eps * conditions, np.sqrt(eps))
    real, imaginary = (np.where(np.abs(x) > least, x, 0.0) for x in map(np.asarray, (values.real, values.imag)))
    return real + 1j * imaginary, shapes


def _widths(linear):
    """For each state, the size of its change of all coordinates in units of the system's size and radians, or of all
    velocities in these units times the fastest rate.
    """
    system, R, kq = linear.system, jnp.abs(linear.basis), linear.coordinates
    nq, last = system.nq, len(linear.states) - system.nz
    by_coordinates = jnp.max(R[:nq, :kq] / system.coordinate_scale()[:, None], axis=0)
    by_rates = jnp.max(R[nq : nq + system.nu, kq:last] / system.velocity_scale()[:, None], axis=0)
    scaled = jnp.abs(linear.A[kq:last]) * by_rates[:, None]
    stiffness, damping = scaled[:, :kq] / by_coordinates[None, :], scaled[:, kq:last] / by_rates[None, :]
    omega = jnp.max(damping, initial=0.0) + jnp.sqrt(jnp.max(stiffness, initial=0.0))
    by_states = 1 / system.state_scale().astype(R.dtype)
    return jnp.concatenate([by_coordinates, by_rates / jnp.where(omega > 0, omega, 1.0), by_states])


def _effective(linear):
    """Whether each state affects itself or another effective state."""
    widths = _widths(linear)
    effects = jnp.abs(linear.A) * widths[:, None] / widths[None, :]
    least = _NO_EFFECT * jnp.max(effects, initial=0.0)

    def reduce(_, kept):
        return kept & (jnp.max(jnp.where(kept[:, None], effects, 0.0), axis=0) > least)

    return lax.fori_loop(0, len(linear.states), reduce, jnp.ones(len(linear.states), bool))


@eqx.filter_jit
def _spectrum(linear):
    """Eigenvalues, and eigenvectors in all states."""
    kept = lax.stop_gradient(_effective(linear))
    values, vectors, of_block = eigen(linear.A, kept)
    A, unit = linear.A.astype(values.dtype), jnp.eye(len(linear.states), dtype=values.dtype)
    size = lax.stop_gradient(jnp.abs(values))
    quick = of_block & (size > _NO_EFFECT * jnp.max(size, initial=0.0))

    def complete(value, vector, quick):
        # States without effect on others follow the others: (λ − A_ii) v_i = A_ik v_k.
        follows = (~kept & quick)[:, None]
        matrix = jnp.where(follows & ~kept[None, :], value * unit - A, unit)
        pushed = A @ jnp.where(kept, vector, jnp.zeros_like(vector))
        return jnp.linalg.solve(matrix, jnp.where(follows[:, 0], pushed, vector))

    vectors = jax.vmap(complete, in_axes=(0, 1, 0), out_axes=1)(values, vectors, quick)
    nq, scale = linear.system.nq, linear.system.coordinate_scale()
    shapes = (linear.basis[:nq] / scale[:, None]).astype(vectors.dtype) @ vectors
    largest = jnp.argmax(jnp.abs(lax.stop_gradient(shapes)), axis=0)
    unity = jnp.take_along_axis(shapes, largest[None, :], axis=0)
    return values, vectors / jnp.where(unity == 0, jnp.ones_like(unity), unity)


@eqx.filter_jit
def _response(linear, omega):
    dtype = np.result_type(linear.A.dtype, np.complex64)
    A, B, C, D = (x.astype(dtype) for x in (linear.A, linear.B, linear.C, linear.D))
    shift = lambda w: lax.complex(jnp.zeros_like(w), w) * jnp.eye(len(linear.states), dtype=dtype)
    return jax.vmap(lambda w: C @ jnp.linalg.solve(shift(w) - A, B) + D)(omega)


def _size(values):
    """`|λ|`, with derivative zero at zero."""
    square = values.real**2 + values.imag**2
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
