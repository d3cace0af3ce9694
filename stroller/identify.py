"""Parameters of a stroller, its ground and its launch from a recorded ride."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from nonholonomic import identification as generic
from nonholonomic.identification import Identification, Measurements, check_recording, sample_labels, samples
from nonholonomic.parameters import numbers
from nonholonomic.validation import as_number, require

from .input import Input
from .launch import Launch
from .scene import Scene
from .simulate import simulate
from .table import place_numbers, replaced

#: Columns of a sample of each quantity.
QUANTITIES = {"position": ("x", "y", "z"), "heading": ("heading",), "speed": ("speed",), "steering": ("steering",)}


class Recording(eqx.Module):
    """A recorded ride: one quantity at some times.

    **Arguments:**

    - `launch`: a `Launch`, every number a scalar.
    - `times`: (times,) [s], increasing from 0 or later.
    - `value`: (times, 3) [m] for "position" (in the fixed frame), (times,) for "heading" [rad], "speed" [m/s] and
      "steering" [rad], all as in `Trajectory`.
    - `error`: standard errors, one for all or of the shape of `value`.
    - `quantity`: one of these words.
    - `input`: what drove the stroller, as for `simulate`.

    **Raises:** `ValueError` for an unknown quantity or shapes that do not fit.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> data = stroller.Recording(launch, times=[0.5, 1.0], value=[1.87, 1.74], error=0.01, quantity="speed")
    >>> data.labels
    ('speed(0.5 s)', 'speed(1 s)')

    ```
    """

    launch: Launch
    times: Float[Array, " times"] = eqx.field(converter=as_number)
    value: Float[Array, "..."] = eqx.field(converter=as_number)
    error: Float[Array, "..."] = eqx.field(converter=as_number)
    quantity: str = eqx.field(static=True, default="position")
    input: Input | None = None

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

    def predict(self, scene: Scene, values: dict[str, Array], tolerance: float) -> Float[Array, "rows n"]:
        """The samples in every row."""

        def one(values):
            roots = replaced({"scene": scene, "launch": self.launch}, values)
            run = simulate(
                roots["scene"],
                roots["launch"],
                self.times[-1],
                self.input,
                self.times,
                tolerance,
            )
            return getattr(run, self.quantity).reshape(-1)

        return jax.vmap(one)(values)


class SceneModel(eqx.Module):
    """Predictions of all recordings of a scene, in the form that `nonholonomic.identification.identify` expects."""

    scene: Scene
    data: tuple[Recording, ...]
    tolerance: float = eqx.field(static=True)

    def __call__(self, parameters: dict[str, Float[Array, " rows"]]) -> Float[Array, "rows n"]:
        return jnp.concatenate([one.predict(self.scene, parameters, self.tolerance) for one in self.data], axis=1)


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
    """Parameters of a scene and its launch from recorded rides, with their errors and with what is not determined.

    **Arguments:**

    - `scene`: a `Scene`; what is not free is taken from it.
    - `data`: a `Recording`, or a list of several to be fitted together.
    - `free`: full name of a parameter -> a `Free` or only the value from which to start: `"scene.friction.rolling"`, or
      `"rolling"` where nothing else ends so; `"launch.place[0]"` and `"launch.place[1]"` are parts of the place. A parameter
      of the launch is the same in all recordings. Parameters that cannot be negative are fitted in their logarithms.
    - `starts`, `spread`, `seed`, `max_steps`, `progress`: as for `nonholonomic.identification.identify`.
    - `tolerance`: relative tolerance of the integration.

    **Returns:** an `Identification`.

    **Raises:** `ValueError` for arguments out of range or an unknown name.

    **Example:**

    ```
    >>> import stroller
    >>> body = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
    >>> scene = stroller.Scene(body, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
    >>> launch = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)
    >>> data = stroller.Recording(launch, times=[0.5, 1.0], value=[1.765, 1.557], error=0.01, quantity="speed")
    >>> found = stroller.identify(scene, data, {"rolling": 1.5}, progress=False)
    >>> print(f"{found.estimates['scene.friction.rolling']:.2f} N s/m, {found.status}")
    2.00 N s/m, converged

    ```
    """
    if not isinstance(scene, Scene):
        raise ValueError(f"scene = {scene!r} must be a Scene")
    data = tuple(data) if isinstance(data, list | tuple) else (data,)
    if not data or not all(isinstance(one, Recording) for one in data):
        raise ValueError(f"data = {data!r} must be a Recording, or a list of them")
    require(tolerance, "tolerance", at_least=1e-14, at_most=1e-2)
    for one in data:
        scene.check(one.launch)
    roots = {"scene": scene, "launch": data[0].launch}
    known = [name for root, tree in roots.items() for name in numbers(root, tree)] + place_numbers(data[0].launch)
    unknowns = generic.free_numbers(free, roots, known, replaced)
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
