"""What can be read off a run of a tippe top, with units and names, and the labelled table of it."""

import json
from typing import Any, NamedTuple

import numpy as np

from nonholonomic.parameters import description
from nonholonomic.sweeps import Table, versions
from nonholonomic.validation import require_one_run

from ..model.rigid_body import AbstractRigidBody


class Quantity(NamedTuple):
    """A property of `Trajectory`: its unit, the dimension of its components if it is a vector, and what it is in words."""

    unit: str
    components: str | None = None
    long_name: str = ""


QUANTITIES = {
    "theta": Quantity("rad", long_name="inclination θ"),
    "eta": Quantity("rad", long_name="place η"),
    "azimuth": Quantity("rad", long_name="azimuth φ"),
    "spin": Quantity("rad s-1", long_name="spin ω₃"),
    "theta_rate": Quantity("rad s-1", long_name="θ'"),
    "energy": Quantity("J", long_name="energy"),
    "jellett": Quantity("kg m3 s-1", long_name="Jellett's quantity"),
    "normal_force": Quantity("N", long_name="normal force"),
    "axis": Quantity("1", "component", "axis e"),
    "position": Quantity("m", "component", "position of the centre"),
    "velocity": Quantity("m s-1", "component", "velocity of the centre"),
    "angular_momentum": Quantity("kg m2 s-1", "component", "angular momentum"),
    "slip": Quantity("m s-1", "tangent", "slip velocity"),
}

#: The directions that components belong to: of the fixed frame, and of the moving one.
COMPONENTS = {"component": ("x", "y", "z"), "tangent": ("t1", "t2")}

#: Of one run only: what has no place among the variables of a table of many.
OF_ONE_RUN = {
    "spin_angle": Quantity("rad", long_name="spin angle"),
    "work": Quantity("J", long_name="work of friction"),
}

#: Of one run of a body of any shape and inertia.
OF_RIGID_BODIES = {
    "normal_spin": Quantity("rad s-1", long_name="spin about the normal"),
    "grip": Quantity("1", long_name="friction over normal force"),
    "reaction": Quantity("N", "component", "force of the arena"),
}


def table_of(run: Any) -> Table:
    """Everything that is read off a run, over its times.

    **Arguments:** `run`: a `Trajectory` or a `HybridTrajectory`, one and not a batch.

    **Raises:** `ValueError` for a batch of runs.
    """
    require_one_run(run, "to_table", "; trajectory_table makes a table of many")
    known = QUANTITIES | OF_ONE_RUN
    if isinstance(run.scene.body, AbstractRigidBody):
        known |= OF_RIGID_BODIES
    dims = [quantity.components for quantity in known.values() if quantity.components is not None]
    coords = {"time": np.asarray(run.t)} | {dim: np.array(COMPONENTS[dim]) for dim in dict.fromkeys(dims)}
    request = description("scene", run.scene) | {"status": str(run.status), "end_time": float(run.end_time)}
    attributes = {
        "request": json.dumps(request, default=repr),
        "axes": json.dumps(["time"]),
        "versions": json.dumps(versions()),
        "long_names": json.dumps(
            {"time": "time"} | {name: quantity.long_name for name, quantity in known.items()}, sort_keys=True
        ),
    }
    return Table(
        coords,
        {name: np.asarray(getattr(run, name)) for name in known},
        {"time": "s"} | {name: quantity.unit for name, quantity in known.items()},
        attributes,
        inner={name: (quantity.components,) for name, quantity in known.items() if quantity.components is not None},
    )
