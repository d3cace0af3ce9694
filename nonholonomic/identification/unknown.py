"""Unknown parameters: start value, bounds, and the coordinate in which they are fitted."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..validation import require, shown


class Free(NamedTuple):
    """A parameter to be fitted.

    With a lower bound, the fit uses the logarithm of the distance from it (for `lower=0.0`, the logarithm of the
    parameter); between two bounds, the logit of the position between them; without bounds, the parameter itself.

    - `start`: value from which the fit starts, strictly within the bounds.
    - `lower`, `upper`: bounds, which a fit approaches but does not reach.
    - `prior`: mean and standard deviation of a Gaussian prior of the parameter itself; or only the standard deviation,
      if the mean is `start`; or `None`.

    **Example:**

    ```
    >>> import tippe
    >>> mu = tippe.Free(0.3, lower=0.0, prior=(0.3, 0.1))
    >>> mu.start, mu.positive
    (0.3, True)

    ```
    """

    start: float
    lower: float = -math.inf
    upper: float = math.inf
    prior: tuple[float, float] | float | None = None

    @property
    def gaussian(self) -> tuple[float, float] | None:
        """Mean and standard deviation of the prior."""
        return as_gaussian(self.prior, self.start)

    @property
    def unit(self) -> float:
        """The unit of changes of the parameter: the size of the start value; if this is 0, the prior's standard
        deviation, or 1."""
        return abs(self.start) or (self.gaussian[1] if self.gaussian else 1.0)

    @property
    def positive(self) -> bool:
        """Whether the parameter cannot be negative."""
        return self.lower >= 0.0

    def value(self, coordinate: Float[Array | np.ndarray, "..."]) -> Float[Array, "..."]:
        """The parameter at a coordinate."""
        return Unknown.of(self).value(coordinate)

    def coordinate(self, value: Any) -> Float[Array, "..."]:
        """The coordinate of a value strictly within the bounds; the inverse of `value`."""
        return Unknown.of(self).coordinate(value)


def as_gaussian(prior: Any, start: float) -> Any:
    """Mean and standard deviation of a prior that may be only a standard deviation about the start value."""
    return (start, prior) if prior is not None and np.ndim(prior) == 0 else prior


class Unknown(eqx.Module):
    """A `Free` for compiled programs. A program depends on which bounds exist and on whether there is a prior, and
    takes their values as arguments.

    - `start`, `unit`, `lower`, `upper`: as for `Free`; `has_lower`, `has_upper`: which bounds are finite.
    - `prior`: mean and standard deviation, or `None`.
    """

    start: Float[Array | np.ndarray, ""]
    unit: Float[Array | np.ndarray, ""]
    lower: Float[Array | np.ndarray, ""]
    upper: Float[Array | np.ndarray, ""]
    prior: Float[Array | np.ndarray, " 2"] | None
    has_lower: bool = eqx.field(static=True)
    has_upper: bool = eqx.field(static=True)

    @classmethod
    def of(cls, free: Free) -> "Unknown":
        """The unknown of a `Free`, with arrays in place of Python numbers, which would become constants of the
        program."""
        numbers = (free.start, free.unit, free.lower, free.upper)
        start, unit, lower, upper = (np.asarray(number, float) for number in numbers)
        prior = None if free.gaussian is None else np.asarray(free.gaussian, float)
        return cls(start, unit, lower, upper, prior, math.isfinite(free.lower), math.isfinite(free.upper))

    @property
    def positive(self) -> bool:
        """Whether the parameter cannot be negative."""
        return bool(self.lower >= 0.0)

    def value(self, coordinate: Float[Array | np.ndarray, "..."]) -> Any:
        """The parameter at a coordinate; in NumPy for a NumPy array, because JAX would compile for every shape."""
        xp: Any = np if isinstance(coordinate, np.ndarray) and isinstance(self.lower, np.ndarray) else jnp
        if self.has_lower and self.has_upper:
            # 1 / (1 + exp(-x)) without an overflow.
            return self.lower + (self.upper - self.lower) * 0.5 * (1.0 + xp.tanh(0.5 * coordinate))
        # A coordinate that is large enough stands for infinity.
        with np.errstate(over="ignore"):
            if self.has_lower:
                return self.lower + xp.exp(coordinate)
            if self.has_upper:
                return self.upper - xp.exp(-coordinate)
        return self.start + self.unit * coordinate

    def coordinate(self, value: Any) -> Float[Array, "..."]:
        """The coordinate of a value strictly within the bounds; the inverse of `value`."""
        value = jnp.asarray(value, float)
        if self.has_lower and self.has_upper:
            return jnp.log(value - self.lower) - jnp.log(self.upper - value)
        if self.has_lower:
            return jnp.log(value - self.lower)
        if self.has_upper:
            return -jnp.log(self.upper - value)
        return (value - self.start) / self.unit


def as_free(free: Any, lower: dict[str, float] | None = None) -> dict[str, Free]:
    """Unknowns as `Free`, checked.

    **Arguments:**

    - `free`: name -> a `Free`, or only the start value.
    - `lower`: name -> lower bound for unknowns given by a value only, or without bounds.

    **Returns:** name -> `Free`.

    **Raises:** `ValueError` that names the unknown and the problem.
    """
    if not isinstance(free, dict) or not free:
        raise ValueError(f"free = {shown(free)} must be a non-empty dictionary, name of a number -> start value")
    unknowns = {}
    for name, start in free.items():
        unknown = start if isinstance(start, Free) else Free(start)
        if unknown.lower == -math.inf and unknown.upper == math.inf:
            unknown = unknown._replace(lower=(lower or {}).get(name, -math.inf))
        require(unknown.start, f"start of {name}")
        if np.ndim(unknown.start) != 0:
            raise ValueError(f"start of {name} must be one number, not of shape {np.shape(unknown.start)}")
        require(unknown.start, f"start of {name}", above=unknown.lower, below=unknown.upper, why="the bounds")
        prior = None
        if unknown.prior is not None:
            if np.shape(unknown.prior) not in ((), (2,)):
                raise ValueError(
                    f"prior of {name} = {shown(unknown.prior)} must be a mean and a standard deviation, or only the standard "
                    "deviation"
                )
            prior = as_gaussian(unknown.prior, float(unknown.start))
            require(prior[0], f"mean of the prior of {name}")
            require(prior[1], f"standard deviation of the prior of {name}", above=0.0)
        unknowns[name] = unknown._replace(
            start=float(unknown.start), lower=float(unknown.lower), upper=float(unknown.upper), prior=prior
        )
    return unknowns
