"""The quantities of a run of the stroller, with units and names, and the table of a run."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nonholonomic.geometry import Plane
from nonholonomic.parameters import description
from nonholonomic.sweeps import Quantity, Table, chosen, run_table
from nonholonomic.validation import require_one_run

QUANTITIES = {
    "place": Quantity("m or rad", "place", "coordinate"),
    "position": Quantity("m", "position of the rear axle", "component"),
    "direction": Quantity("1", "direction of the heading", "component"),
    "heading": Quantity("rad", "heading ψ"),
    "steering": Quantity("rad", "steering angle φ"),
    "steering_rate": Quantity("rad s-1", "φ'"),
    "speed": Quantity("m s-1", "speed v"),
    "front_speed": Quantity("m s-1", "speed of the front wheel"),
    "yaw_rate": Quantity("rad s-1", "yaw rate"),
    "energy": Quantity("J", "energy"),
    "work": Quantity("J", "work of inputs and friction"),
    "drive_power": Quantity("W", "power of the drive", read=lambda run: run.power.drive),
    "steering_power": Quantity("W", "power of the steering", read=lambda run: run.power.steering),
    "friction_power": Quantity("W", "power of friction", read=lambda run: sum(run.power[2:])),
    "side_force": Quantity("N", "side force", "axle"),
    "grip": Quantity("1", "friction that the tyres need", "axle", read=lambda run: run.grip()),
    "load": Quantity("N", "load", "axle"),
    "normal_force": Quantity("N", "normal force"),
}

#: Names of the components of vectors, by dimension.
VECTORS = {"component": ("x", "y", "z"), "axle": ("rear", "front")}


def table_of(runs: list[Any], names: list[str], request: dict[str, Any], only: Sequence[str] = ()) -> Table:
    """All quantities of several runs with the same times, over these times.

    **Arguments:**

    - `runs`: the trajectories.
    - `names`: names of the runs, without spaces, for the axis "ride"; empty for a single run.
    - `request`: plain data that describes the computation.
    - `only`: names of quantities, as for `chosen`.
    """
    flat = {isinstance(run.spec.ride.scene.surface, Plane) for run in runs}
    # On grounds of different kinds, a place has no common unit.
    places, unit = {True: (("x", "y"), "m"), False: (("mu", "eta"), "rad")}[flat.pop()]
    places, unit = (("first", "second"), "m or rad") if flat else (places, unit)
    coords = {"ride": np.array(names)} if names else {}
    coords |= {"time": np.asarray(runs[0].t), "coordinate": np.array(places)}
    coords |= {dim: np.array(names) for dim, names in VECTORS.items()}
    quantities = chosen(QUANTITIES | {"place": QUANTITIES["place"]._replace(unit=unit)}, only)
    of_runs = {name: [np.asarray(quantity.of(name, run)) for run in runs] for name, quantity in quantities.items()}
    values = {name: np.stack(of_each) if names else of_each[0] for name, of_each in of_runs.items()}
    return run_table(quantities, coords, values, [*(["ride"] if names else []), "time"], request)


def table_of_one(run: Any, only: Sequence[str] = ()) -> Table:
    """Quantities of a run, over its times. **Arguments:** `only`: names of quantities, as for `chosen`.

    **Raises:** `ValueError` for a batch of runs.
    """
    require_one_run(run, "to_table", "; stroller.sweep makes a table of many")
    request = description("scene", run.spec.ride.scene) | {"status": run.status}
    return table_of([run], [], request, only)
