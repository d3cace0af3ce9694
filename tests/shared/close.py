"""How close is close."""

import numpy as np


def assert_close(value, expected, rtol=0.0, atol=0.0):
    """Compare arrays, the tolerances stated in full."""
    np.testing.assert_allclose(np.asarray(value), np.asarray(expected), rtol=rtol, atol=atol)
