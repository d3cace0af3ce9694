"""The checker of annotations finds errors of the packages, and lets tests pass illegal arguments."""

import jax.numpy as jnp
import pytest
from checking import check
from jaxtyping import Array, Float, TypeCheckError, jaxtyped

pytestmark = pytest.mark.oldest


@jaxtyped(typechecker=check)
def halved(values: Float[Array, " n"]) -> Float[Array, " n"]:
    return values[::2]


@jaxtyped(typechecker=check)
def size(values: Float[Array, " n"]) -> int:
    return len(values)


def test_a_result_of_another_shape_is_found():
    with pytest.raises(TypeCheckError, match="return value"):
        halved(jnp.ones(4))


def test_arguments_are_checked_in_calls_from_packages_only():
    package = {"__name__": "nonholonomic.example", "size": size}
    exec("def size_of_text(): return size('text')", package)
    with pytest.raises(TypeCheckError, match="parameter 'values'"):
        package["size_of_text"]()
    assert size("text") == 4
