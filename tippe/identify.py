"""Parameters of a top, its arena and its launches from inversion times and from recorded motion."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic import identification as generic
from nonholonomic.identification import Identification, Measurements, check_recording, sample_labels, samples
from nonholonomic.parameters import numbers, with_numbers
from nonholonomic.validation import as_number, require

from .extended_times import extended_inversion_times
from .inversion import check_event, check_run, check_smooth
from .launch import Launch
from .scene import Scene
from .trajectory import simulate

#: Columns of a sample of each quantity that is recorded.
QUANTITIES = {"theta": ("theta",), "position": ("x", "y", "z")}


class InversionTimes(eqx.Module):
    """Measured inversion times of some launches.

    Over a nutation period the time is a staircase in every parameter, so its slope differs from its trend; where theta grows
    without falling back it is smooth. Small angles at the launch, angles to be reached of 0.6 to 0.8 pi, and several
    launches keep the steps below the errors.

    **Arguments:**

    - `launch`: a `Launch` whose numbers are one for all or (launches,).
    - `time`: (launches,) [s], infinite for a launch that was not seen to invert.
    - `error`: standard errors [s], one for all or (launches,).
    - `t1`: until when the model follows a launch [s]: several times the longest time measured, because a start may be far off.
    - `until`: until when a launch that did not invert was watched [s], one for all or (launches,); `t1` by default. Its
      likelihood is one-sided: the probability of a time beyond `until`.
    - `angle`: angle [rad] that counted as inverted.

    **Raises:** `ValueError` for numbers out of range or shapes that do not fit.

    **Example:**

    ```
    >>> import numpy as np
    >>> import tippe
    >>> launch = tippe.Launch(theta=[0.1, 0.1, 0.2], spin=[155.0, 140.0, 120.0])
    >>> data = tippe.InversionTimes(launch, time=[5.97, 6.9, np.inf], error=0.02, t1=20.0)
    >>> data.labels
    ('theta 0.1, spin 155', 'theta 0.1, spin 140', 'theta 0.2, spin 120')

    ```
    """

    launch: Launch
    time: Float[Array, " launches"] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    t1: Float[Array, ""] = eqx.field(converter=as_number)
    until: Any = None
    angle: Float[Array, ""] = eqx.field(converter=as_number, default=0.95 * math.pi)

    def __check_init__(self):
        if np.ndim(self.time) != 1 or np.size(self.time) == 0:
            raise ValueError(f"time must be a non-empty list, not of shape {np.shape(self.time)}")
        require(self.t1, "t1", above=0.0)
        check_event(self.angle, "first")
        seen = np.isfinite(np.asarray(self.time))
        if np.any(np.isnan(np.asarray(self.time))):
            raise ValueError("time must be numbers, infinite where a launch did not invert")
        require(np.asarray(self.time)[seen], "time", above=0.0, below=self.t1, why="t1")
        if self.until is not None:
            require(self.until, "until", above=0.0, at_most=self.t1, why="t1")
        alike = numbers("launch", self.launch) | {"error": self.error, "until": self.until}
        for name, value in alike.items():
            if value is not None and np.shape(value) not in ((), np.shape(self.time)):
                raise ValueError(f"{name} must be one number or one for each launch, not of shape {np.shape(value)}")

    @property
    def measurements(self) -> Measurements:
        """The times as `Measurements`."""
        censored = ~np.isfinite(np.asarray(self.time))
        until = self.t1 if self.until is None else self.until
        return Measurements(np.where(censored, np.asarray(until), np.asarray(self.time)), self.error, censored)

    @property
    def labels(self) -> tuple[str, ...]:
        """A label for each launch."""
        columns = np.broadcast_arrays(np.asarray(self.launch.theta), np.asarray(self.launch.spin), self.time)
        return tuple(f"theta {theta:.4g}, spin {spin:.4g}" for theta, spin in zip(*columns[:2], strict=True))

    def predict(
        self, scene: Scene, values: dict[str, Array], rows: int, tolerance: float
    ) -> Float[Array, "rows launches"]:
        """Times of all launches in every row, all of them lanes of one block."""
        launches = len(self.time)
        spread = {name: jnp.repeat(value, launches) for name, value in values.items()}
        launch = jax.tree.map(lambda leaf: jnp.tile(jnp.broadcast_to(leaf, (launches,)), rows), self.launch)
        roots = with_numbers({"scene": scene, "launch": launch}, spread)
        times = extended_inversion_times(
            roots["scene"], roots["launch"], self.t1, self.angle, tolerance, lanes=rows * launches
        )
        return times.reshape(rows, launches)


class Recording(eqx.Module):
    """A recorded run: theta, or the position of the sphere's centre, at some times.

    **Arguments:**

    - `launch`: a `Launch`, every number a scalar.
    - `times`: (times,) [s], increasing from 0 or later.
    - `value`: (times,) [rad] for "theta", (times, 3) [m] for "position" (in the fixed frame, as in `simulate`).
    - `error`: standard errors, one for all or of the shape of `value`.
    - `quantity`: "theta" or "position".

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:**

    ```
    >>> import tippe
    >>> data = tippe.Recording(tippe.Launch(0.1, 155.0), times=[0.5, 1.0], value=[0.09, 0.11], error=0.01)
    >>> data.labels
    ('theta(0.5 s)', 'theta(1 s)')

    ```
    """

    launch: Launch
    times: Float[Array, " times"] = eqx.field(converter=as_number)
    value: Float[Array, "..."] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    quantity: str = eqx.field(static=True, default="theta")

    def __check_init__(self):
        check_recording(self.times, self.value, self.quantity, QUANTITIES)

    @property
    def measurements(self) -> Measurements:
        """The samples as `Measurements`."""
        return samples(self.value, self.error)

    @property
    def labels(self) -> tuple[str, ...]:
        """A label for each sample."""
        return sample_labels(self.times, QUANTITIES[self.quantity])

    def predict(self, scene: Scene, values: dict[str, Array], rows: int, tolerance: float) -> Float[Array, "rows n"]:
        """The samples in every row; NaN after a run's end."""

        def one(values):
            roots = with_numbers({"scene": scene, "launch": self.launch}, values)
            run = simulate(
                roots["scene"],
                roots["launch"],
                self.times[-1],
                self.times,
                tolerance,
            )
            return getattr(run, self.quantity).reshape(-1)

        return jax.vmap(one)(values)


class SceneModel(eqx.Module):
    """Predictions of all data of a scene, in the form that `nonholonomic.identification.identify` expects."""

    scene: Scene
    data: tuple[Any, ...]
    tolerance: float = eqx.field(static=True)

    def __call__(self, parameters: dict[str, Float[Array, " rows"]]) -> Float[Array, "rows n"]:
        rows = len(next(iter(parameters.values())))
        parts = [one.predict(self.scene, parameters, rows, self.tolerance) for one in self.data]
        return jnp.concatenate(parts, axis=1)


def identify(
    scene: Scene,
    data: Any,
    free: dict[str, Any],
    *,
    starts: int = 1,
    spread: float = 2.0,
    seed: int = 0,
    tolerance: float = 1e-8,
    max_steps: int = 60,
    progress: bool = True,
) -> Identification:
    """Parameters of a scene and its launches from measurements, with their errors and with what is not determined.

    **Arguments:**

    - `scene`: a `Scene`; what is not free is taken from it.
    - `data`: an `InversionTimes` or a `Recording`, or a list of several to be fitted together.
    - `free`: full name of a parameter -> a `Free` or only the value from which to start: `"scene.friction.mu"`, or
      `"friction.mu"` where nothing else ends so; a parameter of the launch is the same in all launches of all data.
      Parameters that cannot be negative are fitted in their logarithms.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.identify`.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification`.

    **Raises:** `ValueError` for arguments out of range, an unknown name, and a scene with `contact="hybrid"` or
    `SetValuedCoulomb`, through whose phases the derivative does not go.

    **Example:**

    ```
    >>> import tippe
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> launch = tippe.Launch(theta=[0.2, 0.2, 0.3, 0.2], spin=[155.0, 140.0, 110.0, 60.0])
    >>> data = tippe.InversionTimes(launch, time=[5.60, 5.53, 5.52, float("inf")], error=0.05, t1=8.0)
    >>> found = tippe.identify(scene, data, {"friction.mu": 0.25}, progress=False)
    >>> print(f"{found.estimates['scene.friction.mu']:.3f} s/m, {found.status}")
    0.300 s/m, converged

    ```
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    check_smooth(scene, "identify")
    data = tuple(data) if isinstance(data, list | tuple) else (data,)
    if not data or not all(isinstance(one, InversionTimes | Recording) for one in data):
        raise ValueError(f"data = {data!r} must be an InversionTimes or a Recording, or a list of them")
    roots = {"scene": scene, "launch": data[0].launch}
    check_run(scene, Launch(0.0, 0.0), 1.0, tolerance)
    known = [name for root, tree in roots.items() for name in numbers(root, tree)]
    unknowns = generic.free_numbers(free, roots, known, with_numbers)
    measurements, labels = generic.joined(data)
    return generic.identify(
        SceneModel(scene, data, tolerance),
        measurements,
        unknowns,
        starts=starts,
        spread=spread,
        seed=seed,
        max_steps=max_steps,
        labels=labels,
        progress=progress,
    )
