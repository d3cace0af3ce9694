"""Ready-made strollers and scenes.

`light` and `loaded` return a `Stroller`, `slope` and `bowl` a `Scene`, whose stroller is its `.body`. Each has a second
name that says so: `light_stroller`, `loaded_stroller`, `slope_scene` and `bowl_scene`.

The papers on the stroller state no numbers. We chose ordinary values; no stroller was measured.

**Example:**

```
>>> import stroller
>>> ride = stroller.simulate(stroller.presets.bowl(), stroller.Launch((0.0, -0.9), 0.4, 2.0), t1=2.0)
>>> ride.status
'completed'

```
"""

from nonholonomic.geometry import Plane, Spheroid

from .friction import Damping
from .model.scene import Scene, Stroller


def light() -> Stroller:
    """An empty stroller: 12 kg, 0.7 m from the rear axle to the front wheel.

    Its yaw inertia of 1.5 kg m^2 corresponds to 12 kg at 0.35 m from the rear axle. The centre of mass is above the
    rear axle.

    **Example:**

    >>> stroller.presets.light()
    Stroller(mass=12 kg, wheelbase=0.7 m, inertia=1.5 kg m², steering_inertia=0.05 kg m²)
    """
    return Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)


def loaded() -> Stroller:
    """The stroller with a child of 10 kg: its centre of mass is 0.2 m ahead of the rear axle, and loads the front wheel.

    Its equations hold on a plane only, as for every stroller with `centre`.

    **Example:**

    >>> print(stroller.presets.loaded().centre)
    0.2
    """
    return Stroller(mass=22.0, wheelbase=0.7, inertia=2.6, steering_inertia=0.05, centre=0.2)


def slope() -> Scene:
    """The light stroller on a plane tilted by 0.05 rad (5 %), with rolling resistance and a damped fork.

    **Example:**

    >>> print(stroller.presets.slope().surface)
    Plane(tilt=0.05 rad)
    """
    return Scene(light(), Plane(0.05), Damping(2.0, 1.0, 0.2, 0.05))


def bowl() -> Scene:
    """The light stroller inside a spheroid 12 m wide and 6 m high, with the same friction.

    **Example:**

    >>> print(stroller.presets.bowl().surface)
    Spheroid(equatorial=6 m, polar=3 m)
    """
    return Scene(light(), Spheroid(6.0, 3.0), Damping(2.0, 1.0, 0.2, 0.05), side="inside")


light_stroller, loaded_stroller = light, loaded
slope_scene, bowl_scene = slope, bowl
