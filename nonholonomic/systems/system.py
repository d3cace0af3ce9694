"""Systems that can be run: hybrid systems, and mechanical systems converted to hybrid ones."""

import dataclasses
import difflib
import functools
import inspect
from types import CodeType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..formulations import AbstractFormulation, AbstractSystem, Hamel, Lagrange
from ..formulations.system import within_constraints
from ..lanes.tracing import named_errors
from ..validation import as_number, require, shown
from ..warning import warn
from .form import EXIT, Form
from .mode import AbstractMode, Event, Hybrid, State, exit_of


class MechanicalMode(AbstractMode):
    """The motion of a mechanical system, in the state of one of its formulations, as mode `number` of a hybrid system."""

    formulation: AbstractFormulation
    number: int = eqx.field(static=True, default=0)

    def field(self, t: Float[Array, ""], y: State) -> State:
        return self.formulation.field(t, y)

    def margin(self, t: Float[Array, ""], y: State) -> Any:
        return self.formulation.system.margin(t, *self.formulation.split(y))

    def reset(self, t: Float[Array, ""], y: State, *exit: Any) -> tuple[State, Any] | None:
        system: Any = self.formulation.system
        following = system.reset(t, *self.formulation.split(y), *exit)
        if following is None:
            return None
        q, rate, *number = following
        return self.formulation.state(q, rate), number[0] if number else self.number

    @property
    def is_projected(self) -> bool:
        """Whether a state may violate the constraints, so that `entered` projects it."""
        system = self.formulation.system
        return isinstance(self.formulation, Lagrange) and system.freedom < system.dimension

    def entered(self, t: Float[Array, ""], y: State) -> State:
        """The state after a reset to this mode, with rates that obey the constraints."""
        q, rate = self.formulation.split(y)
        return self.formulation.state(q, within_constraints(self.formulation.system, q, rate))


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


def with_modes_of_systems(hybrid: Hybrid) -> Hybrid:
    """The hybrid system with the equations of motion of the mechanical systems among its modes, for states (q, rate)."""
    modes = tuple(
        MechanicalMode(Lagrange(mode), number) if isinstance(mode, AbstractSystem) else mode
        for number, mode in enumerate(hybrid.modes)
    )
    return dataclasses.replace(hybrid, modes=modes)


def is_pair(start: Any) -> bool:
    """Whether a start is a pair (q, rate) of vectors."""
    return isinstance(start, tuple | list) and len(start) == 2 and all(np.ndim(as_number(part)) == 1 for part in start)


def check_start(system: Hybrid | AbstractSystem, start: Any) -> None:
    """Raise `ValueError` unless the start is one of this system, and warn of misspelt methods."""
    modes = [system] if isinstance(system, AbstractSystem) else system.modes
    for mode in modes:
        warn_of_misspelt_methods(mode, AbstractSystem if isinstance(mode, AbstractSystem) else AbstractMode)
    mechanical = {number: mode for number, mode in enumerate(modes) if isinstance(mode, AbstractSystem)}
    sizes = {mode.dimension for mode in mechanical.values()}
    if len(sizes) > 1:
        raise ValueError(
            f"the systems among the modes must have one number of coordinates, not {', '.join(map(str, sorted(sizes)))}"
        )
    (size,) = sizes or (None,)
    if isinstance(system, AbstractSystem) and not (isinstance(start, tuple | list) and len(start) == 2):
        raise ValueError(f"start = {shown(start)} must be a pair (q, rate) of coordinates and their rates")
    if isinstance(system, AbstractSystem) or (mechanical and is_pair(start)):
        for name, part in zip(("q", "rate"), start, strict=True):
            _check_vector(part, f"start: {name}", size)
    else:
        _check_vector(start, "start", None if size is None else 2 * size)
    for number, mode in mechanical.items():
        prefix = "" if mode is system else f"modes[{number}]."
        if prefix and type(mode).lagrangian is not AbstractSystem.lagrangian:
            raise ValueError(
                f"{prefix}lagrangian: a system with a Lagrangian of its own cannot be a mode; write metric and potential"
            )
        form = Form.of(Hybrid([MechanicalMode(Lagrange(mode))]), 2 * mode.dimension)[0]
        _check_functions(form, prefix)


def _check_vector(value: Any, name: str, size: int | None) -> None:
    value = as_number(value)
    if not isinstance(value, jax.Array):
        raise ValueError(f"{name} = {shown(value)} is not a list of numbers")
    require(value, name)
    shape = f"({'components' if size is None else size},)"
    if np.ndim(value) != 1 or np.size(value) == 0 or size not in (None, np.size(value)):
        raise ValueError(f"{name} must be of shape {shape}, not {np.shape(value)}; jax.vmap or sweep runs many")


@functools.lru_cache(maxsize=256)
def _check_functions(form: Form, prefix: str) -> None:
    """Raise `ValueError` that names a function of a system that JAX cannot trace or that returns a wrong shape.

    **Arguments:** `form`: that of a `Hybrid` of one `MechanicalMode`, so that a system with other numbers is not traced
    again; `prefix`: that of the names of the functions.
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
            lambda shape: shape is not None and len(shape) == 2 and shape[1] == n,
        ),
        "frame(q)": ((q,), f"of shape ({n}, {n})", lambda shape: shape == (n, n)),
        "force(t, q, rate)": ((t, q, q), f"of shape ({n},)", lambda shape: shape in ((), (1,), (n,))),
        "margin(t, q, rate)": (
            (t, q, q),
            "one number, an array of shape (k,), a dict of numbers by name, or None",
            lambda shape: shape is None or (shape != "" and (set(shape) == {()} or len(shape) < 2)),
        ),
        "reset(t, q, rate)": (
            (t, q, q),
            f"(q, rate), both of shape ({n},), or None; as a mode of a Hybrid also (q, rate, number of the next mode)",
            lambda shape: shape is None or (shape[:2] == ((n,), (n,)) and shape[2:] in ((), ((),))),
        ),
    }

    def called(method: str, numbers: Any, *arguments: Any) -> Any:
        mode: Any = form.system(numbers).modes[0]
        system = mode.formulation.system
        exit = exit_of(system.margin(*arguments), 0) if method == "reset" else ()
        return getattr(system, method)(*arguments, *exit)

    for name, (arguments, expected_shape, fits) in functions.items():
        words = f"the coordinates q{' and their rates, each' if 'rate' in name else ','} of shape ({n},)"
        words = (f"the time t, a number, and {words}" if "(t" in name else words) + EXIT * name.startswith("reset")
        with named_errors(f"{prefix}{name}", words):
            result = jax.eval_shape(functools.partial(called, name.partition("(")[0]), numbers, *arguments)
        shape = _shape_of(result)
        if name.startswith("margin") and result is None:
            break  # Nothing calls the reset.
        if not fits(shape):
            raise ValueError(f"{prefix}{name} must be {expected_shape}, not {shown(result) if shape == '' else shape}")


def _shape_of(result: Any) -> Any:
    """The shape of an array, a tuple of those of several arrays, `None` for `None`, and "" for anything else."""
    result = tuple(result.values()) if isinstance(result, dict) else result
    if isinstance(result, tuple):
        return tuple(map(_shape_of, result))
    return None if result is None else getattr(result, "shape", "")


#: Least similarity of a name to a known one, as `difflib` measures it: "forces" and "force" have 0.91.
SIMILARITY = 0.75


def warn_of_misspelt_methods(part: Any, base: type) -> None:
    """Warn of every method of a mode or a system that resembles a method of its base class which the class does not
    define, unless another method of the class calls it; and of a reset without a margin.

    **Arguments:** `part`: an object of a user's class; `base`: `AbstractMode` or `AbstractSystem`.
    """
    kind = type(part)
    free = [name for name in vars(base) if not name.startswith("_") and getattr(kind, name) is getattr(base, name)]
    own = {name for parent in kind.__mro__[: kind.__mro__.index(base)] for name in vars(parent)}
    own -= {field.name for field in dataclasses.fields(kind)}
    methods = {name: getattr(kind, name) for name in sorted(own) if inspect.isfunction(getattr(kind, name, None))}
    for name in methods:
        matches = difflib.get_close_matches(name, free, 1, SIMILARITY)
        others = (function for other, function in methods.items() if other != name)
        if matches and not name.startswith("_") and not any(name in _names(other.__code__) for other in others):
            warn(f"{kind.__name__}.{name} is never called; did you mean {matches[0]}?")
    if "reset" not in free and "margin" in free:
        warn(
            f"{kind.__name__}.reset is never called: write margin as well, which falls to zero where the reset happens"
        )


def _names(code: CodeType) -> set[str]:
    """The names that a function and the functions inside it use."""
    inner = (constant for constant in code.co_consts if isinstance(constant, CodeType))
    return set(code.co_names).union(*map(_names, inner))
