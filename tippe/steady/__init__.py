"""Steady motions of the tippe top, their stability, and the resulting thresholds and groups (`tippe.md`, section 6).

A standing top spins with its axis along the normal: upright (stem out, theta = 0) or inverted (stem in, theta = pi). On
the plane, tumbling tops lie between: the axis precesses at a fixed inclination, with the centre of mass at rest and
without slip. The formulas hold for friction laws that vanish only with the slip, not for `Contensou` and `Rolling`,
under which every spin decays; alpha = a / R and gamma = I1 / I3. For a top with a stem, the formulas describe the
motions on the top's own sphere; only `inverted_critical_spin` refers to the stem, on which such a top stands inverted.

The stability matrices are Jacobians of the scene's own field, without the directions that are neutral by symmetry or by
conservation, so an eigenvalue with a positive real part always means instability.

**Example:**

```
>>> import tippe
>>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
>>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
>>> from tippe import steady
>>> steady.group(top)
'II'
>>> print(f"an inverted top is stable above {steady.inverted_critical_spin(scene):.2f} rad/s")
an inverted top is stable above 41.31 rad/s
>>> print(f"{steady.tumbling(scene, 1.0).precession:.2f} rad/s")
37.24 rad/s

```
"""

from .stability import growth_rate as growth_rate
from .stability import standing_matrix as standing_matrix
from .stability import standing_state as standing_state
from .stability import tumbling_matrix as tumbling_matrix
from .tumbling_tops import Tumbling as Tumbling
from .tumbling_tops import effective_energy as effective_energy
from .tumbling_tops import folds as folds
from .tumbling_tops import group as group
from .tumbling_tops import inverted_critical_spin as inverted_critical_spin
from .tumbling_tops import jellett_thresholds as jellett_thresholds
from .tumbling_tops import proportions as proportions
from .tumbling_tops import quarter_turn as quarter_turn
from .tumbling_tops import tumbling as tumbling
from .tumbling_tops import tumbling_angles as tumbling_angles
from .tumbling_tops import tumbling_is_stable as tumbling_is_stable
from .tumbling_tops import tumbling_state as tumbling_state
from .tumbling_tops import upright_critical_spin as upright_critical_spin
