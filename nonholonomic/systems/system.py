"""Systems that can be run: hybrid systems, and mechanical systems converted to hybrid ones."""

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..formulations import AbstractFormulation, AbstractSystem, Hamel, Lagrange
from ..validation import UNTRACEABLE, as_number, is_traced, require, shown
from .form import Form
from .misspelt import warn_of_misspelt_methods
from .mode import AbstractMode, Event, Hybrid, State

#: Largest relative violation of the constraints by a start's velocity.
VIOLATION = 1e-9


class MechanicalMode(AbstractMode):
    """The motion of a mechanical system, in the state of one of its formulations."""

    formulation: AbstractFormulation

    def field(self, t: Float[Array, ""], y: State) -> State:
        return self.formulation.field(t, y)


class MechanicalEvent(eqx.Module):
    """An event of a mechanical system, as a function of the formulation's state."""

    formulation: AbstractFormulation
    event: Event

    def __call__(self, t: Float[Array, ""], y: State) -> Float[Array, ""]:
        return self.event(t, jnp.concatenate(self.formulation.split(y)))


def formulation_of(system: AbstractSystem) -> AbstractFormulation:
    """The equations of motion for a mechanical system.

    If the system has its own frame, or its own Lagrangian (which may have terms linear in the velocities), the
    equations are in quasi-velocities, which obey the constraints exactly; otherwise they use Lagrange multipliers.
    """
    has_frame = type(system).frame is not AbstractSystem.frame
    has_lagrangian = type(system).lagrangian is not AbstractSystem.lagrangian
    return Hamel(system) if has_frame or has_lagrangian else Lagrange(system)


def check_start(system: Hybrid | AbstractSystem, start: Any) -> None:
    """Raise `ValueError` unless the start is one of this system, and warn of misspelt methods."""
    if isinstance(system, AbstractSystem):
        warn_of_misspelt_methods(system, AbstractSystem)
        _check_mechanical_start(system, start)
    else:
        for mode in system.modes:
            warn_of_misspelt_methods(mode, AbstractMode)
        _check_vector(start, "start", None)


def _check_vector(value: Any, name: str, size: int | None) -> None:
    value = as_number(value)
    require(value, name)
    shape = f"({'components' if size is None else size},)"
    if np.ndim(value) != 1 or np.size(value) == 0 or size not in (None, np.size(value)):
        raise ValueError(f"{name} must be of shape {shape}, not {np.shape(value)}; jax.vmap or sweep runs many")


@functools.lru_cache(maxsize=256)
def _check_mechanical_functions(form: Form) -> None:
    """Raise `ValueError` that names a function of a system that JAX cannot trace or that returns a wrong shape.

    **Arguments:** `form`: that of a `Hybrid` of one `MechanicalMode`, so that a system with other numbers is not traced
    again.
    """
    n = form.size // 2
    numbers, t, _ = form.arguments
    q = jax.ShapeDtypeStruct((n,), t.dtype)
    functions = {
        "metric(q)": ((q,), f"of shape ({n}, {n})", lambda shape: shape == (n, n)),
        "potential(q)": ((q,), "one number", lambda shape: shape == ()),
        "constraints(q)": (
            (q,),
            f"of shape (k, {n}), a row for each constraint",
            lambda shape: len(shape) == 2 and shape[1] == n,
        ),
        "frame(q)": ((q,), f"of shape ({n}, {n})", lambda shape: shape == (n, n)),
        "force(t, q, rate)": ((t, q, q), f"of shape ({n},)", lambda shape: shape in ((), (1,), (n,))),
    }

    def called(method: str, numbers: Any, *arguments: Any) -> Any:
        mode: Any = form.system(numbers).modes[0]
        return getattr(mode.formulation.system, method)(*arguments)

    for name, (arguments, expected_shape, fits) in functions.items():
        try:
            result = jax.eval_shape(functools.partial(called, name.partition("(")[0]), numbers, *arguments)
        except jax.errors.JAXTypeError as error:
            raise ValueError(f"{name} {UNTRACEABLE}") from error
        shape = getattr(result, "shape", None)
        if shape is None or not fits(shape):
            raise ValueError(f"{name} must be {expected_shape}, not {result if shape is None else shape}")


def _check_mechanical_start(system: AbstractSystem, start: Any) -> None:
    if not isinstance(start, tuple | list) or len(start) != 2:
        raise ValueError(f"start = {shown(start)} must be a pair (q, rate) of coordinates and their rates")
    for name, part in zip(("q", "rate"), start, strict=True):
        _check_vector(part, f"start: {name}", system.dimension)
    _check_mechanical_functions(Form.of(Hybrid([MechanicalMode(Lagrange(system))]), 2 * system.dimension)[0])
    q, rate = (as_number(part) for part in start)
    constraints = system.constraints(q)
    if not constraints.size:
        return
    violation, frame = constraints @ rate, constraints @ system.frame(q)[:, : system.freedom]
    if is_traced(violation) or is_traced(frame):
        return
    error = float(jnp.max(jnp.abs(violation)))
    if error > VIOLATION * float(jnp.max(jnp.abs(constraints)) * jnp.max(jnp.abs(rate))):
        raise ValueError(
            f"start: rate = {np.asarray(rate)} violates the constraints by {error:.3g}; constraints(q) @ rate must be 0"
        )
    component = float(jnp.max(jnp.abs(frame)))
    if isinstance(formulation_of(system), Hamel) and component > VIOLATION * float(jnp.max(jnp.abs(constraints))):
        raise ValueError(
            f"frame(q): the constraints must annihilate its first {system.freedom} columns, and do so only up to "
            f"{component:.3g}; leave it out to run with Lagrange multipliers"
        )
