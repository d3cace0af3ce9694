"""One run of a user's system at given times."""

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from ..hybrid import MOST_ROUNDS, hybrid_resets
from ..integration import Settings
from ..integration.status import Status
from ..parameters import of_all_modes
from ..sweeps import Quantity, Table, Tabular, run_table
from ..text import as_text, batch_title, distinguishing_labels, likely
from ..validation import is_traced, times_within
from ..views import Page, Stage, Viewable, new_figure
from .explore import explore_model
from .model import AbstractModel
from .portrait import portraits

#: Why a run ended early, by its word.
REASONS = {
    "failed": "a function may return NaN or infinity there, or reset the index of no mode",
    "unresolved": "resets followed one another without end; add a mode for rest, or start where the margin is positive; or "
    f"the run is too long: it may have at most {MOST_ROUNDS} resets",
}


class Trajectory(Viewable, Tabular, eqx.Module):
    """A run of your own system at given times. The times are the first axis of the arrays; `jax.vmap` adds an axis
    before it.

    - `t`: times [s], (times,).
    - `state`: (times, components), NaN after the end of the run; for an `AbstractSystem` the coordinates, followed by
      their rates. At the time of a reset, this is the state before the reset.
    - `mode`: index of the mode, (times,), -1 after the end.
    - `end_time`: time at which the run ended [s]; `switches`: number of resets.
    - `steps`, `rejected`: numbers of all integration steps and of rejected steps.
    - `code`: the status as an integer of `Status`.
    - `names`: names of the components in tables; `run[name]` is a component at the times, and so is `run.height` for a
      component named "height".
    - `model`, `t1`, `settings`: the model, the horizon and the settings of the integration.

    Pictures also show the states before and after each reset, whatever the times.

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
    model: AbstractModel
    t1: Float[Array, ""]
    settings: Settings
    names: tuple[str, ...] = eqx.field(static=True)

    @property
    def status(self) -> Any:
        """How the run ended: "completed" at `t1`; "stopped" if a mode without a reset ended; "failed"; "unresolved"
        if resets followed one another without end; or, inside a transformation, "illegal" for a start that raises an error
        elsewhere.

        For a batch of runs, an array of words; inside a transformation, the integer.
        """
        if is_traced(self.code):
            return self.code
        words = np.vectorize(lambda code: Status(code).word, otypes=[object])(np.asarray(self.code))
        return str(words) if words.ndim == 0 else words.astype(str)

    @property
    def portrait_axes(self) -> tuple[str, str]:
        return self.names[0], self.names[-1]

    @functools.cached_property
    def resets(self) -> Table:
        """The resets of the run, a `Table` with a row for each: its `time` [s], the indices `mode_before` and
        `mode_after`, and the components of the state, such as `y0_before` and `y0_after`. The run is repeated for it.

        **Raises:** `ValueError` inside transformations and for a batch of runs: `mode` and `switches` are there.
        """
        if not self._is_one_run:
            raise ValueError(
                "resets takes one run outside jit, vmap and grad; run.mode and run.switches work there too"
            )
        resets = []
        if not self.model.smooth and int(self.switches):
            modes, first, states = self.model.without_event().modes(1, self.settings.tolerance, None, False)
            start = (modes, int(np.asarray(first)[0]), np.asarray(states)[:, 0])
            changes = hybrid_resets(*start, float(self.t1), self.settings, counters=len(self.model.counters))
            # The end of a mode without a reset is not counted.
            resets = [pair for pair in changes if np.any(pair[1].counts > pair[0].counts)]
        columns = {"time": np.array([after.end_time[0] for _, after in resets], float)}
        for k, word in enumerate(("before", "after")):
            columns[f"mode_{word}"] = np.array([pair[k].mode[0] for pair in resets], int)
        for k, word in enumerate(("before", "after")):
            model: Any = self.model
            states = [model.components_of(jnp.asarray(pair[k].state[:, 0])) for pair in resets]
            components = np.array(states, float).reshape(-1, len(self.names))
            columns |= {f"{name}_{word}": components[:, part] for part, name in enumerate(self.names)}
        return Table({"reset": np.arange(1, len(resets) + 1)}, columns, {"time": "s"}, {})

    @property
    def _is_one_run(self) -> bool:
        """Whether this is a single run outside of transformations."""
        return not is_traced(self.code) and np.ndim(self.code) == 0

    def _with_resets(self) -> "Trajectory":
        """The run with the states before and after each reset in addition, so that its lines do not cut corners; a batch,
        and a run of one time, stay unchanged."""
        if not self._is_one_run or len(self.t) < 2 or not int(self.switches):
            return self
        resets, t = self.resets, np.asarray(self.t)
        is_within = (resets["time"] >= t[0]) & (resets["time"] <= t[-1])
        times = np.repeat(resets["time"][is_within], 2)
        places = np.searchsorted(t, times, side="right")

        def added(before: str, after: str) -> np.ndarray:
            return np.stack([resets[before][is_within], resets[after][is_within]], axis=-1).reshape(-1)

        states = np.stack([added(f"{name}_before", f"{name}_after") for name in self.names], axis=-1)
        t, state, mode = np.insert(t, places, times), np.asarray(self.state), np.asarray(self.mode)
        state = np.insert(state, places, states, axis=0)
        mode = np.insert(mode, places, added("mode_before", "mode_after"))
        return dataclasses.replace(self, t=t, state=state, mode=mode)

    def to_table(self) -> Table:
        """The run as a `Table` over its times.

        **Raises:** `ValueError` for a batch of runs.
        """
        if np.ndim(self.t) != 1 or np.ndim(self.state) != 2:
            raise ValueError(
                "this is a batch of runs, and to_table takes one run; nonholonomic.sweep makes a table of many"
            )
        columns = dict(zip(self.names, np.asarray(self.state).T, strict=True)) | {"mode": np.asarray(self.mode)}
        request = self.model.description() | {"status": self.status, "end_time": float(self.end_time)}
        quantities = self.model.quantities | {"mode": Quantity("1", "mode")}
        table = run_table(quantities, {"time": np.asarray(self.t)}, columns, ["time"], request)
        # Earlier versions had only this attribute.
        return dataclasses.replace(table, attributes=table.attributes | {"status": self.status})

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __getattr__(self, name: str) -> Float[Array, " times"]:
        # Python calls this only for names that are not attributes, also while a copy has none yet.
        names = vars(self).get("names", ())
        if name not in names:
            known = ("t", "state", *names)
            raise AttributeError(f"the run has no {name!r}{likely(name, known)}; it has {', '.join(known)}")
        return self[name]

    def __getitem__(self, name: str) -> Float[Array, " times"]:
        if name not in self.names:
            raise KeyError(f"{name!r} must be one of {', '.join(self.names)}")
        return self.state[..., self.names.index(name)]

    def at(self, times: Float[ArrayLike, " times"]) -> "Trajectory":
        """The same run at other times; the run is repeated.

        **Arguments:** `times`: increasing, within [0, `end_time`] [s]; or one time, for a run of one time.

        **Raises:** `ValueError` for times outside the run, and for a batch of runs.
        """
        if not self._is_one_run:
            raise ValueError("at takes one run outside jit, vmap and grad: pass times= to simulate there")
        times = times_within(times, self.end_time, "run")
        return self.model.simulate(self.t1, times, self.settings.tolerance, self.settings.solver, None)

    def stages(self, others: Sequence[Any] = (), overlaid: bool = False, unit: Any = None) -> list[Stage]:
        return portraits([run._with_resets() for run in (self, *others)], overlaid)

    def table_of(self, names: Sequence[str]) -> Table:
        """The table that pictures draw, with the states before and after each reset."""
        return self._with_resets().to_table()

    def explore(
        self, path: Any = None, sliders: dict[str, tuple[float, float]] | None = None, unit: Any = None
    ) -> Page:
        """A page with sliders that simulates the run in the browser; see `nonholonomic.explore`."""
        return explore_model(self.model, path, sliders, float(self.t1), unit)

    def labels_of(self, runs: list[Any], unit: Any) -> list[str]:
        """Labels that tell runs apart by the numbers of their systems and starts that differ."""
        models = [run.model for run in runs]
        names = models[0].known
        if any(model.known != names for model in models):
            return Tabular.labels_of(self, runs, unit)
        values = {name: [as_text(model.value(name)) for model in models] for name in names}
        texts = [[f"{label} {text}" for text in values[name]] for name, label in brief_names(values).items()]
        numbers = list(zip(*texts, strict=True))
        return distinguishing_labels(numbers) if len(set(numbers)) > 1 else Tabular.labels_of(self, runs, unit)

    def overview(self, runs: list[Any], labels: Sequence[str], unit: Any, ax: Any) -> Any:
        """Draw all components of a run in one picture, or a panel for each component of several runs."""
        if len(runs) > 1 or unit is not None:
            return Tabular.overview(self, [run._with_resets() for run in runs], labels, unit, ax)
        figure = new_figure()
        axes: Any = figure.add_subplot() if ax is None else ax
        drawn = self._with_resets()
        for name, component in zip(self.names, np.asarray(drawn.state).T, strict=True):
            axes.plot(np.asarray(drawn.t), component, label=name)
        axes.set_xlabel("time [s]")
        axes.legend()
        return figure if ax is None else ax

    def __str__(self) -> str:
        if is_traced(self.code) or np.ndim(self.t) != 1:
            codes = [] if is_traced(self.code) else np.ravel(self.code)
            return batch_title(jnp.shape(self.state)[:-1], [Status(int(code)).word for code in codes])
        table = str(self.to_table()).splitlines()[1 : 1 + len(self.names)]
        lines = [f"Trajectory of {np.size(self.t)} times, {self.status} at {float(self.end_time):.6g} s", *table]
        lines.append(f"  resets: {int(self.switches)}")
        lines.append(f"  steps: {int(self.steps)}, of which {int(self.rejected)} rejected")
        if self.status in REASONS:
            lines.append(f"  {REASONS[self.status]}")
        return "\n".join(lines)


def brief_names(values: dict[str, list[str]]) -> dict[str, str]:
    """The parameters that a label may name: full name -> its last part, or the full name if several names end alike.

    A parameter with the same value in all modes that have it counts once, under its name for all modes. All other
    parameters count under their names in each mode.

    **Arguments:** `values`: full name -> the value in each run.
    """
    groups = {name: [single for single in values if single != name == of_all_modes(single)] for name in values}
    shared = {name for name, group in groups.items() if group and all(values[k] == values[name] for k in group)}
    names = [name for name in values if name in shared or not (groups[name] or of_all_modes(name) in shared)]
    ends = [name.rsplit(".", 1)[-1] for name in names]
    return {name: end if ends.count(end) == 1 else name for name, end in zip(names, ends, strict=True)}
