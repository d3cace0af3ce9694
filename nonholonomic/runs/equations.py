"""A checksum of the equations of a model, so that a table does not resume with the cells of other equations."""

import dataclasses
import hashlib
import re
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array

from ..compilation.programs import opened, programs_in
from .ensemble import Ensemble
from .model import AbstractModel

#: The packages whose code changes only with the version, which tables compare too.
PACKAGES = ("nonholonomic", "tippe", "stroller", "jax", "equinox")

#: The address of an object in the text of a program.
ADDRESS = re.compile(r" at 0x[0-9a-f]+")


def has_users_code(part: Any) -> bool:
    """Whether a tree of modules has a function, or a module of a class, that is not of these packages."""
    if isinstance(part, eqx.Module):
        if type(part).__module__.partition(".")[0] not in PACKAGES:
            return True
        return any(has_users_code(getattr(part, field.name)) for field in dataclasses.fields(part))
    if isinstance(part, tuple | list | dict):
        return any(map(has_users_code, part.values() if isinstance(part, dict) else part))
    # Functions can also be compiled or methods. An object that can be called, such as a partial function, has data.
    is_own = str(getattr(part, "__module__", "")).partition(".")[0] in PACKAGES
    return callable(part) and not (is_own and hasattr(part, "__qualname__"))


def checksum_of(model: AbstractModel) -> str:
    """A checksum of the operations that compute the rates, the events and the resets of a model, and of the constants in them,
    but not of its parameters."""
    arrays, static = eqx.partition(model, eqx.is_array)

    def equations(arrays: Any) -> list[Any]:
        ensemble = Ensemble.of(eqx.combine(arrays, static), 1, jnp.asarray(1e-9), False)
        state, time = ensemble.starts, jnp.zeros(1)
        modes = ensemble.modes or ()
        problems = [ensemble.problem] if ensemble.problem is not None else [mode.problem(state) for mode in modes]
        parts: list[Any] = [
            (problem.field(time, state), problem.event_function(state), problem.domain_margin(time, state))
            for problem in problems
        ]
        return [*parts, *(mode.reset_map(state, jnp.ones(1)) for mode in modes)]

    program = jax.make_jaxpr(equations)(arrays)
    checksum = hashlib.sha256(ADDRESS.sub("", str(program)).encode())
    # The text of a program does not show all digits of the constants.
    for inner in programs_in(program):
        jaxpr, parts = opened(inner)
        for equation in jaxpr.eqns:
            literals = [operand.val for operand in equation.invars if isinstance(operand, Literal)]
            parts = [*parts, *literals, *jax.tree.leaves(list(equation.params.values()))]
        for array in (np.asarray(part) for part in parts if isinstance(part, Array | np.ndarray | np.generic)):
            checksum.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return checksum.hexdigest()[:16]
