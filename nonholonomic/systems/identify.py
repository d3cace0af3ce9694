"""Estimate parameters of a user's system from recorded runs."""

import dataclasses
import re
from collections.abc import Hashable
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..formulations import AbstractSystem
from ..identification import (
    AbstractDataModel,
    AbstractRecording,
    Identification,
    Quantities,
    as_quantity,
    as_sources,
    fit_data,
    free_numbers,
    model_times,
    search_options,
)
from ..integration.checks import tolerance_bound
from ..progress import status_line
from ..validation import as_number, as_number_or_none, shown
from .mode import Hybrid
from .numbers import Named, check_again, require_apart
from .simulate import simulate
from .system import System, check_run, run_of


@dataclasses.dataclass(frozen=True)
class Components(Quantities):
    """The components of a state, in any number: "y0" and so on, or "q0", "rate0" and so on."""

    def of(self, quantity: Any) -> tuple[str, ...]:
        names = quantity if isinstance(quantity, tuple) else (quantity,)
        unknown_names = [name for name in names if not (isinstance(name, str) and re.fullmatch(r"(y|q|rate)\d+", name))]
        if unknown_names or not names or len(set(names)) < len(names):
            raise ValueError(
                f"quantity = {shown(quantity)} must name components, such as 'y0' or ('q0', 'rate0'), each once"
            )
        return names


class Recording(AbstractRecording):
    """A recorded run of your own system: components of its state, sampled at the times of a clock.

    **Arguments:**

    - `launch`: the start, as for `simulate`.
    - `times`: (times,), increasing.
    - `value`: (times,) for a single component, (times, columns) for several; NaN where a sample is missing.
    - `error`: standard errors: a scalar, (columns,), or of the shape of `value`; with `None`, they are estimated for
      each column from the residuals.
    - `quantity`: names of the recorded components, as in `Trajectory.names`, such as "y0" or ("q0", "q1").
    - `t0`: the clock's reading at the start.
    - `student`: degrees of freedom, such as 4, of Student's t distribution of the errors, for outliers; `None`:
      Gaussian.

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:**

    >>> import nonholonomic
    >>> heights = nonholonomic.Recording([1.0, 0.0], [0.1, 0.2], [0.95, 0.80], 0.01, "y0")
    >>> heights.labels
    ('y0(0.1 s)', 'y0(0.2 s)')
    """

    quantity: str | tuple[str, ...] = eqx.field(static=True, default="y0", converter=as_quantity)
    t0: Float[Array, ""] = eqx.field(converter=as_number, default=0.0)
    student: Float[Array, ""] | None = eqx.field(converter=as_number_or_none, default=None)
    quantities: ClassVar[Quantities] = Components({}, {}, frozenset())


class SystemModel(AbstractDataModel):
    """Predictions of all recordings of a system."""

    system: System
    data: tuple[Recording, ...]
    seen: Int[Array, " n"]
    tolerance: Float[Array, ""] = eqx.field(converter=as_number)

    def together(self, source: Recording, values: dict[str, Array]) -> Hashable:
        return None

    def predict(
        self, sources: list[tuple[Recording, dict[str, Array]]], rows: int
    ) -> list[Float[Array, "rows samples"]]:
        return [jax.vmap(lambda row, launch=launch: self._predict(launch, row))(values) for launch, values in sources]

    def _predict(self, recording: Recording, row: dict[str, Array]) -> Float[Array, " samples"]:
        """Predictions for the recording of one run, ordered by time."""
        parameters_of_data = numbers_of(self.system, recording)
        tree = parameters_of_data.tree(parameters_of_data.replaced(row))
        times = model_times(recording.times, row.get("t0", recording.t0))
        start = tree["start"]
        start = (start["q"], start["rate"]) if isinstance(start, dict) else start
        run = simulate(tree["system"], start, times[-1], times=times, tolerance=self.tolerance)
        places = [run.names.index(name) for name in recording.columns]
        return run.state[:, jnp.asarray(places)].reshape(-1)


def numbers_of(system: System, recording: Recording) -> Named:
    """The parameters of a system and of the start of a recording, by name."""
    start = recording.launch
    if isinstance(system, AbstractSystem):
        start = dict(zip(("q", "rate"), map(as_number, start), strict=True))
    return Named.of({"system": system, "start": start if isinstance(start, dict) else as_number(start)})


def identify(
    system: System,
    data: Any,
    free: dict[str, Any],
    *,
    starts: int = 16,
    spread: float = 2.0,
    seed: int = 0,
    tolerance: float = 1e-8,
    max_steps: int = 60,
    progress: bool = True,
) -> Identification:
    """Estimate parameters and starts of your own system from recorded runs, with errors and undetermined combinations.

    **Arguments:**

    - `system`: a `Hybrid`, or an `AbstractSystem`, with the values of the parameters that are not free.
    - `data`: a `Recording`, or a list of several to be fitted together.
    - `free`: full name of a parameter -> a `nonholonomic.Free` or only the start value. Examples of names are
      `"system.modes[0].drag"`, or `"drag"` if no other name ends so, `"modes[*].drag"` for all modes that have a drag,
      `"start[0]"`, `"start.q[0]"` and `"t0"`, the reading of a recording's clock at the start. `"start[0]"` and `"t0"`
      are the same in all recordings; `"data[1].start[0]"` belongs to the second recording, and `"data[*].t0"` is a
      separate parameter for each. In systems with resets, `"t0"` cannot be free.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.identify`.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification` with its `verdict`; a doubtful fit gives a `FitWarning`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:**

    ```
    >>> import jax.numpy as jnp
    >>> import nonholonomic
    >>> class Decay(nonholonomic.AbstractMode):
    ...     rate: float
    ...
    ...     def field(self, t, y):
    ...         return -self.rate * y
    >>> data = nonholonomic.Recording([1.0], [0.5, 1.0, 1.5], [0.37, 0.135, 0.05], 0.005)
    >>> fit = nonholonomic.identify(nonholonomic.Hybrid([Decay(1.0)]), data, {"rate": 1.0}, progress=False)
    >>> print(f"{fit.estimates['system.modes[0].rate']:.2f}")
    1.99

    ```
    """
    search = search_options(starts, spread, seed, max_steps, progress)
    data = as_sources(data, Recording, "a nonholonomic.Recording")
    for recording in data:
        check_run(system, recording.launch, recording.times[-1], tolerance)
        names = run_of(system, recording.launch, None).names
        if not set(recording.columns) <= set(names):
            raise ValueError(
                f"quantity = {shown(recording.quantity)} must name components of the state: {', '.join(names)}"
            )
    tolerance_bound(tolerance).require()
    if isinstance(system, Hybrid):
        system = dataclasses.replace(system, event=None)
    parameters_of_data = [numbers_of(system, recording) for recording in data]
    names_of_data = [
        [name for name in numbers.movable if name.startswith("start")] + ["t0"] for numbers in parameters_of_data
    ]
    shared = [name for name in parameters_of_data[0].known if name.startswith("system")]

    def check(values: dict[str, float]) -> None:
        check_again(
            parameters_of_data[0].tree(
                parameters_of_data[0].replaced({name: jnp.asarray(value) for name, value in values.items()})
            )
        )

    with status_line("fitting", progress):
        unknowns = free_numbers(free, shared, names_of_data, check)
        require_apart("free", unknowns)
        return fit_data(
            lambda indices: SystemModel(system=system, data=data, seen=jnp.asarray(indices), tolerance=tolerance),
            data,
            unknowns,
            search,
        )
