"""A user's mechanical system as a hybrid system, and the checks that it and its start are legal."""

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

from ..compilation.tracing import named_errors
from ..formulations import AbstractFormulation, AbstractSystem, Hamel, Lagrange, within_constraints
from ..text import shown
from ..validation import as_number, require, warn
from .form import EXIT, AbstractMode, Event, Form, Hybrid, State, exit_of

# Systems that can be run: hybrid systems, and mechanical systems converted to hybrid ones.


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


# Whether runs of a user's system may start: rules for concrete and traced numbers, and their messages.

#: The margin, in units of the greatest component of the start, below zero by more than which a start is outside its mode; and
#: the largest relative violation of the constraints. In single precision, both are greater.
OUTSIDE = VIOLATION = 1e-9

#: Round-off of the rules in units of the precision of a number of size 1.
ROUND_OFF = 64.0

#: The rules in the order in which the first broken one is reported.
RULES = ("start", "finite", "symmetry", "rank", "metric", "constraints", "frame", "margin")

#: Arrays by name; those of several cells have the cells along the first axis.
Arrays = dict[str, Any]


def parts_of_start(system: Hybrid | AbstractSystem, start: Any) -> Arrays:
    """What the rules compare: the start, the least margin of the first mode, and the functions of a mechanical one.

    **Arguments:** `start`: a state, or {"q": coordinates, "rate": rates}.
    """
    first: Any = system.modes[system.first] if isinstance(system, Hybrid) else system
    y = jnp.concatenate([start["q"], start["rate"]]) if isinstance(start, dict) else start
    parts, arguments = {"y": y}, (y,)
    if isinstance(first, AbstractSystem):
        q, rate = arguments = jnp.split(y, 2)
        has_metric = type(first).lagrangian is AbstractSystem.lagrangian
        parts["metric"] = first.metric(q) if has_metric else jax.hessian(first.lagrangian, argnums=1)(q, rate)
        parts["constraints"] = W = first.constraints(q)
        if W.shape[0] and first.freedom and isinstance(formulation_of(first), Hamel):
            parts["frame"] = W @ first.frame(q)[:, : first.freedom]
    margins = jax.tree.leaves(first.margin(jnp.zeros((), y.dtype), *arguments))
    return parts | ({"margin": functools.reduce(jnp.minimum, map(jnp.min, margins))} if margins else {})


def rooms(parts: Arrays, xp: Any) -> Arrays:
    """The room that each rule leaves: name of a rule in `RULES` -> a number below zero, or NaN, where the start breaks it.

    **Arguments:** `parts`: those of one start or of many; `xp`: `numpy` or `jax.numpy`. For a few starts, NumPy saves the
    time to compile.
    """
    y = parts["y"]
    round_off = ROUND_OFF * float(jnp.finfo(y.dtype).eps)
    exact = max(VIOLATION, round_off)
    left = {"start": 0.0 * xp.sum(y, axis=-1)}
    if "metric" in parts:
        left |= _rooms_of_rates(parts, xp, round_off, exact)
    if "margin" in parts:
        left["margin"] = parts["margin"] + max(OUTSIDE, round_off) * xp.maximum(1.0, _greatest(xp, y, 1))
    return left


def _greatest(xp: Any, values: Any, axes: int) -> Any:
    """The greatest magnitude along the last axes."""
    return xp.max(xp.abs(values), axis=tuple(range(-axes, 0)), initial=0.0)


def _rooms_of_rates(parts: Arrays, xp: Any, round_off: float, exact: float) -> Arrays:
    """The room that the rules of metric, constraints and frame leave."""
    G, W, n = parts["metric"], parts["constraints"], parts["metric"].shape[-1]
    left = {"finite": 0.0 * (xp.sum(G, axis=(-1, -2)) + xp.sum(W, axis=(-1, -2)))}
    # In units in which each coordinate with a mass has a mass of 1, the rules do not depend on the user's units.
    # Pages and components know no primitive for a diagonal.
    identity = xp.eye(n, dtype=G.dtype)
    unit = xp.sqrt(xp.abs(xp.sum(G * identity, axis=-1)))
    unit = xp.where(unit > 0.0, unit, 1.0)
    scaled = G / (unit[..., :, None] * unit[..., None, :])
    left["symmetry"] = exact - _greatest(xp, scaled - scaled.swapaxes(-1, -2), 2)
    # Projectors on the allowed directions and on the others, by orthonormal rows: batches of LAPACK inside a compiled program
    # can deadlock.
    allowed, others = xp.broadcast_to(identity, G.shape), xp.zeros_like(G)
    independent = xp.ones_like(left["finite"])
    for k in range(W.shape[-2]):
        row = _unit(xp, W[..., k, :] / unit)
        part = _projected(allowed, row)
        independent = xp.minimum(independent, xp.sqrt(xp.sum(part * part, axis=-1)))
        # The second projection removes the round-off of the first.
        part = _unit(xp, _projected(allowed, _unit(xp, part)))
        square = part[..., :, None] * part[..., None, :]
        allowed, others = allowed - square, others + square
    if W.shape[-2]:
        rate, greatest = parts["y"][..., n:], _greatest(xp, W, 2)
        left["rank"] = independent - round_off ** (2.0 / 3.0)
        left["constraints"] = exact * greatest * _greatest(xp, rate, 1) - _greatest(xp, _projected(W, rate), 1)
        if "frame" in parts:
            left["frame"] = exact * greatest - _greatest(xp, parts["frame"], 2)
    left["metric"] = _least_pivot(xp, allowed @ scaled @ allowed + others) - n * round_off
    return left


def _projected(matrix: Any, vector: Any) -> Any:
    return (matrix @ vector[..., None])[..., 0]


def _unit(xp: Any, vector: Any) -> Any:
    return vector / xp.sqrt(xp.sum(vector * vector, axis=-1))[..., None]


def _least_pivot(xp: Any, matrix: Any) -> Any:
    """The least pivot of a symmetric matrix, which is positive if and only if the matrix is positive definite."""
    least = matrix[..., 0, 0]
    while matrix.shape[-1] > 1:
        pivot, column = matrix[..., 0, 0], matrix[..., 1:, 0]
        matrix = matrix[..., 1:, 1:] - column[..., :, None] * (column / pivot[..., None])[..., None, :]
        least = xp.minimum(least, matrix[..., 0, 0])
    return least


def problem_of_start(parts: dict[str, np.ndarray], rule: str, mode: str) -> str:
    """What is wrong with a start that breaks a rule. **Arguments:** `mode`: prefix of the names of functions."""
    if rule == "start":
        return f"start = {parts['y']} must be finite"
    if rule == "margin":
        return f"start: the margin of the first mode is {parts['margin']:.4g}, below zero; start where the margin is positive"
    W, G = parts["constraints"], parts["metric"]
    n, k = len(G), len(W)
    if rule == "finite":
        name, value = ("constraints", W) if np.isfinite(G).all() else ("metric", G)
        return f"{mode}{name}(q) = {value.tolist()} at the start must be finite"
    if rule == "symmetry":
        return f"{mode}metric(q) = {G.tolist()} at the start must be symmetric"
    if rule == "constraints":
        rate = parts["y"][n:]
        error = np.max(np.abs(W @ rate))
        return f"start: rate = {rate} violates the constraints by {error:.3g}; constraints(q) @ rate must be 0"
    if rule == "frame":
        return (
            f"{mode}frame(q): the constraints must annihilate its first {n - k} columns, and do so only up to "
            f"{np.max(np.abs(parts['frame'])):.3g}; leave it out to run with Lagrange multipliers"
        )
    lengths = np.linalg.norm(W, axis=1, keepdims=True)
    spanned = np.linalg.svd(W / np.where(lengths > 0.0, lengths, 1.0)) if k else (None, np.zeros(0), np.eye(n))
    if rule == "rank":
        return (
            f"{mode}constraints(q) has {k} rows of rank {(spanned[1] > VIOLATION).sum()} at the start, and its rows must be "
            "independent: leave out those that follow from the others"
        )
    allowed = spanned[2][k:]
    least = np.linalg.eigvalsh(allowed @ G @ allowed.T)[0]
    return (
        f"{mode}metric(q) must be positive for all rates that the constraints allow, and its least eigenvalue for them is "
        f"{least:.4g} at the start: a mass or a moment of inertia may be zero or negative, or the coordinates singular there"
    )
