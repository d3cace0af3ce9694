"""What keeps a long session of compiled programs healthy."""

import jax
import pytest


@pytest.fixture(scope="module", autouse=True)
def forget_compiled_programs():
    """Let go of a module's compiled programs: a process may hold only so many memory mappings."""
    yield
    jax.clear_caches()
