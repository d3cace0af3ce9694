"""Tolerances in single precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

from nonholonomic.integration import Settings
from nonholonomic.sweeps.table import other_tolerances


def test_a_tolerance_is_bounded_by_the_precision_with_a_warning():
    assert float(Settings(1e-12).tolerance) == 1e-12
    assert other_tolerances(1e-5) == pytest.approx([1e-7, 1e-9])
    with jax.enable_x64(False):
        with pytest.warns(
            UserWarning, match=r"tolerance = 1e-09 is finer than single precision resolves, and 1e-05 takes"
        ):
            assert_close(Settings(1e-9).tolerance, np.float32(1e-5))
        assert_close(Settings(1e-3).tolerance, np.float32(1e-3))
        # An illegal tolerance stays illegal.
        traced = jax.jit(lambda value: Settings(value).tolerance)
        assert_close(jax.vmap(traced)(jnp.array([1e-9, -1.0])), np.float32([1e-5, -1.0]))
        assert other_tolerances(1e-5) == pytest.approx([1e-3])
