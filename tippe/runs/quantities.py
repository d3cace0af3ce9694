"""The quantities of a run of a tippe top, with units and names, and the table of a run."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nonholonomic.parameters import description
from nonholonomic.sweeps import Quantity, Table, chosen, run_table
from nonholonomic.validation import require_one_run

from ..model.rigid_body import AbstractRigidBody

QUANTITIES = {
    "theta": Quantity("rad", "inclination θ"),
    "eta": Quantity("rad", "place η"),
    "azimuth": Quantity("rad", "azimuth φ"),
    "spin": Quantity("rad s-1", "spin ω₃"),
    "theta_rate": Quantity("rad s-1", "θ'"),
    "energy": Quantity("J", "energy"),
    "jellett": Quantity("kg m3 s-1", "Jellett's quantity"),
    "normal_force": Quantity("N", "normal force"),
    "axis": Quantity("1", "axis e", "component"),
    "position": Quantity("m", "position of the centre", "component"),
    "velocity": Quantity("m s-1", "velocity of the centre", "component"),
    "angular_momentum": Quantity("kg m2 s-1", "angular momentum", "component"),
    "slip": Quantity("m s-1", "slip velocity", "tangent"),
}

#: Names of components: in the fixed frame, and in the moving frame.
COMPONENTS = {"component": ("x", "y", "z"), "tangent": ("t1", "t2")}

#: Quantities of a single run that tables of many runs do not have.
OF_ONE_RUN = {
    "spin_angle": Quantity("rad", "spin angle"),
    "work": Quantity("J", "work of friction"),
}

#: Quantities of a single run of a body of any shape and inertia.
OF_RIGID_BODIES = {
    "normal_spin": Quantity("rad s-1", "spin about the normal"),
    "grip": Quantity("1", "friction over normal force"),
    "reaction": Quantity("N", "force of the arena", "component"),
}


def table_of(run: Any, names: Sequence[str] = ()) -> Table:
    """Quantities of a run, over its times.

    **Arguments:** `run`: a `Trajectory` or a `HybridTrajectory`, not a batch; `names`: as for `chosen`.

    **Raises:** `ValueError` for a batch of runs.
    """
    require_one_run(run, "to_table", "; trajectory_table makes a table of many")
    quantities = QUANTITIES | OF_ONE_RUN
    if isinstance(run.scene.body, AbstractRigidBody):
        quantities |= OF_RIGID_BODIES
    quantities = chosen(quantities, names)
    dims = [quantity.components for quantity in quantities.values() if quantity.components is not None]
    coords = {"time": np.asarray(run.t)} | {dim: np.array(COMPONENTS[dim]) for dim in dict.fromkeys(dims)}
    values = {name: np.asarray(quantity.of(name, run)) for name, quantity in quantities.items()}
    request = description("scene", run.scene) | {"status": str(run.status), "end_time": float(run.end_time)}
    return run_table(quantities, coords, values, ["time"], request)
