"""One run of a user's system at given times."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..integration.status import FAILED, LEFT_DOMAIN, REACHED_END, UNRESOLVED
from ..sweeps import Table, Tabular
from ..validation import is_traced
from ..views import new_figure

#: The words for how a run without an event ends, by code.
WORDS = {REACHED_END: "completed", LEFT_DOMAIN: "stopped", FAILED: "failed", UNRESOLVED: "unresolved"}

#: Why a run ended early, by its word.
REASONS = {
    "failed": "a function may return NaN or infinity there, or reset the index of no mode",
    "unresolved": "resets followed one another without end; add a mode for rest, or start where the margin is positive",
}


class Trajectory(Tabular, eqx.Module):
    """A run of your own system at given times. The times are the first axis of the arrays; `jax.vmap` adds an axis
    before it.

    - `t`: times [s], (times,).
    - `state`: (times, components), NaN after the end of the run; for an `AbstractSystem` the coordinates, followed by
      their rates. At the time of a reset, this is the state before the reset.
    - `mode`: index of the mode, (times,), -1 after the end.
    - `end_time`: time at which the run ended [s]; `switches`: number of resets.
    - `steps`, `rejected`: numbers of all integration steps and of rejected steps.
    - `code`: the status as an integer.
    - `names`: names of the components in tables.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> run = nonholonomic.simulate(nonholonomic.Hybrid([Decay(2.0)]), [1.0], 1.0, times=[0.5, 1.0])
    >>> print(run.status, run.state.shape, f"{run.state[-1, 0]:.6f}")  # exp(-2)
    completed (2, 1) 0.135335

    ```
    """

    t: Float[Array, " times"]
    state: Float[Array, "times components"]
    mode: Int[Array, " times"]
    end_time: Float[Array, ""]
    switches: Int[Array, ""]
    steps: Int[Array, ""]
    rejected: Int[Array, ""]
    code: Int[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def status(self) -> Any:
        """How the run ended: "completed" at `t1`; "stopped" if a mode without a reset ended; "failed"; or "unresolved"
        if resets followed one another without end.

        For a batch of runs, an array of words; inside a transformation, the integer.
        """
        if is_traced(self.code):
            return self.code
        words = np.vectorize(WORDS.get, otypes=[object])(np.asarray(self.code))
        return str(words) if words.ndim == 0 else words.astype(str)

    @property
    def portrait_axes(self) -> tuple[str, str]:
        return self.names[0], self.names[-1]

    def to_table(self) -> Table:
        """The run as a `Table` over its times.

        **Raises:** `ValueError` for a batch of runs.
        """
        if np.ndim(self.t) != 1 or np.ndim(self.state) != 2:
            raise ValueError(
                "this is a batch of runs, and to_table takes one run; nonholonomic.sweep makes a table of many"
            )
        columns = dict(zip(self.names, np.asarray(self.state).T, strict=True)) | {"mode": np.asarray(self.mode)}
        return Table({"time": np.asarray(self.t)}, columns, {"time": "s"}, {"status": self.status})

    def overview(self, runs: list[Any], labels: list[str], unit: Any, ax: Any) -> Any:
        """Draw all components of a run in one picture, or a panel for each component of several runs."""
        if len(runs) > 1 or unit is not None:
            return super().overview(runs, labels, unit, ax)
        figure = new_figure()
        axes: Any = figure.add_subplot() if ax is None else ax
        for name, component in zip(self.names, np.asarray(self.state).T, strict=True):
            axes.plot(np.asarray(self.t), component, label=name)
        axes.set_xlabel("time [s]")
        axes.legend()
        return figure if ax is None else ax

    def __str__(self) -> str:
        if is_traced(self.code) or np.ndim(self.t) != 1:
            shape = "x".join(map(str, jnp.shape(self.state)))
            return f"Trajectory(status={self.status}, state of shape {shape}, {', '.join(self.names)})"
        table = str(self.to_table()).splitlines()[1 : 1 + len(self.names)]
        lines = [f"Trajectory of {np.size(self.t)} times, {self.status} at {float(self.end_time):.6g} s", *table]
        lines.append(f"  resets: {int(self.switches)}")
        lines.append(f"  steps: {int(self.steps)}, of which {int(self.rejected)} rejected")
        if self.status in REASONS:
            lines.append(f"  {REASONS[self.status]}")
        return "\n".join(lines)
