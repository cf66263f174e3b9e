import equinox as eqx
import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(autouse=True, scope="module")
def _forget_programs():
    """Give back the memory maps of a module's compiled programs: a process may have 65530 of them and no more."""
    yield
    eqx.clear_caches()
    jax.clear_caches()
