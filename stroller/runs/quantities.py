"""What is read off a run of the stroller, with units and names, and the labelled table of it."""

import json
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from nonholonomic.geometry import Plane
from nonholonomic.parameters import description
from nonholonomic.sweeps import Table, versions
from nonholonomic.validation import require_one_run


class Quantity(NamedTuple):
    """What can be read off a run: its unit, what it is in words, how to read it, and the dimension of a vector's components."""

    unit: str
    long_name: str
    read: Callable[[Any], Any]
    components: str | None = None


QUANTITIES = {
    "place": Quantity("m or rad", "place", lambda run: run.place, "coordinate"),
    "position": Quantity("m", "position of the rear axle", lambda run: run.position, "component"),
    "direction": Quantity("1", "direction of the heading", lambda run: run.direction, "component"),
    "heading": Quantity("rad", "heading ψ", lambda run: run.heading),
    "steering": Quantity("rad", "steering angle φ", lambda run: run.steering),
    "steering_rate": Quantity("rad s-1", "φ'", lambda run: run.steering_rate),
    "speed": Quantity("m s-1", "speed v", lambda run: run.speed),
    "front_speed": Quantity("m s-1", "speed of the front wheel", lambda run: run.front_speed),
    "yaw_rate": Quantity("rad s-1", "yaw rate", lambda run: run.yaw_rate),
    "energy": Quantity("J", "energy", lambda run: run.energy),
    "work": Quantity("J", "work of inputs and friction", lambda run: run.work),
    "drive_power": Quantity("W", "power of the drive", lambda run: run.power.drive),
    "steering_power": Quantity("W", "power of the steering", lambda run: run.power.steering),
    "friction_power": Quantity("W", "power of friction", lambda run: sum(run.power[2:])),
    "side_force": Quantity("N", "side force", lambda run: run.side_force, "axle"),
    "grip": Quantity("1", "friction that the tyres need", lambda run: run.grip(), "axle"),
    "load": Quantity("N", "load", lambda run: run.load, "axle"),
    "normal_force": Quantity("N", "normal force", lambda run: run.normal_force),
}


def table_of(runs: list[Any], names: list[str], request: dict[str, Any]) -> Table:
    """Everything that is read off some runs over their times, which are the same for all.

    **Arguments:**

    - `runs`: a `Trajectory` each.
    - `names`: of the runs, without spaces, which become an axis "ride"; none for the only run.
    - `request`: plain data that says what was computed.
    """
    flat = {isinstance(run.spec.ride.scene.surface, Plane) for run in runs}
    # On grounds of both kinds a place has no common unit.
    places, unit = {True: (("x", "y"), "m"), False: (("mu", "eta"), "rad")}[flat.pop()]
    places, unit = (("first", "second"), "m or rad") if flat else (places, unit)
    coords = {"ride": np.array(names)} if names else {}
    coords |= {"time": np.asarray(runs[0].t), "coordinate": np.array(places)}
    coords |= {"component": np.array(("x", "y", "z")), "axle": np.array(("rear", "front"))}
    values_by_name = {name: [np.asarray(quantity.read(run)) for run in runs] for name, quantity in QUANTITIES.items()}
    units = {"time": "s"} | {name: quantity.unit for name, quantity in QUANTITIES.items()}
    units["place"] = unit
    long_names = {"time": "time"} | {name: quantity.long_name for name, quantity in QUANTITIES.items()}
    attributes = {
        "request": json.dumps(request, default=repr),
        "axes": json.dumps([*(["ride"] if names else []), "time"]),
        "versions": json.dumps(versions()),
        "long_names": json.dumps(long_names, sort_keys=True),
    }
    return Table(
        coords,
        {name: np.stack(values) if names else values[0] for name, values in values_by_name.items()},
        units,
        attributes,
        inner={
            name: (quantity.components,) for name, quantity in QUANTITIES.items() if quantity.components is not None
        },
    )


def table_of_one(run: Any) -> Table:
    """Everything that is read off a run, over its times.

    **Raises:** `ValueError` for a batch of runs.
    """
    require_one_run(run, "to_table", "; stroller.sweep makes a table of many")
    request = description("scene", run.spec.ride.scene) | {"status": run.status}
    return table_of([run], [], request)
