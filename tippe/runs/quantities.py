"""The quantities of a run of a tippe top, with units and names, and the table of a run."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from nonholonomic.parameters import description
from nonholonomic.sweeps import Quantity, Table, chosen, run_table
from nonholonomic.validation import require_one_run

from ..model.rigid_body import AbstractRigidBody

#: What a quantity may need in addition to the state: a frame that does not turn about n; the path on a curved arena, or on
#: any arena; the rotation about the axis and the work; the start of the run.
DIRECTION, ON_CURVED, PATH, PASSIVE, START = (
    frozenset({name}) for name in ("direction", "curved", "path", "passive", "start")
)

QUANTITIES = {
    "theta": Quantity("rad", "inclination θ"),
    "eta": Quantity("rad", "place η", needs=ON_CURVED),
    "azimuth": Quantity("rad", "azimuth φ", needs=DIRECTION),
    "spin": Quantity("rad s-1", "spin ω₃"),
    "theta_rate": Quantity("rad s-1", "θ'"),
    "energy": Quantity("J", "energy"),
    "jellett": Quantity("kg m3 s-1", "Jellett's quantity"),
    "normal_force": Quantity("N", "normal force"),
    "axis": Quantity("1", "axis e", "component", needs=DIRECTION | ON_CURVED),
    "position": Quantity("m", "position of the centre", "component", needs=DIRECTION | PATH),
    "velocity": Quantity("m s-1", "velocity of the centre", "component", needs=DIRECTION | ON_CURVED),
    "angular_momentum": Quantity("kg m2 s-1", "angular momentum", "component", needs=DIRECTION | ON_CURVED),
    "slip": Quantity("m s-1", "slip velocity", "tangent", needs=DIRECTION),
    "jellett_drift": Quantity("1", "relative drift of Jellett's quantity", needs=START),
    "spin_angle": Quantity("rad", "spin angle", needs=PASSIVE),
    "work": Quantity("J", "work of friction", needs=PASSIVE),
}

#: Quantities of a body of any shape and inertia.
OF_RIGID_BODIES = {
    "normal_spin": Quantity("rad s-1", "spin about the normal"),
    "grip": Quantity("1", "friction over normal force"),
    "reaction": Quantity("N", "force of the arena", "component", needs=DIRECTION | ON_CURVED),
}

#: Names of components: in the fixed frame, and in the moving frame.
COMPONENTS = {"component": ("x", "y", "z"), "tangent": ("t1", "t2")}


def quantities_of(scene: Any) -> dict[str, Quantity]:
    """The quantities of runs in a scene."""
    return QUANTITIES | OF_RIGID_BODIES if isinstance(scene.body, AbstractRigidBody) else QUANTITIES


def table_of(run: Any, names: Sequence[str] = ()) -> Table:
    """Quantities of a run, over its times.

    **Arguments:** `run`: a `Trajectory` or a `HybridTrajectory`, not a batch; `names`: as for `chosen`.

    **Raises:** `ValueError` for a batch of runs.
    """
    require_one_run(run, "to_table", "; trajectory_table makes a table of many")
    quantities = chosen(quantities_of(run.scene), names)
    dims = [quantity.components for quantity in quantities.values() if quantity.components is not None]
    coords = {"time": np.asarray(run.t)} | {dim: np.array(COMPONENTS[dim]) for dim in dict.fromkeys(dims)}
    values = {name: np.asarray(quantity.of(name, run)) for name, quantity in quantities.items()}
    request = description("scene", run.scene) | ({} if run.launch is None else description("launch", run.launch))
    request |= {"status": str(run.status), "end_time": float(run.end_time)}
    return run_table(quantities, coords, values, ["time"], request)
