"""An explicit Runge-Kutta pair of orders 8 and 7 for motions that oscillate or rotate, the default of ensemble solves.

Its free weights minimise the error of a step along the motions of tops and strollers, for lengths at which the error is
about the tolerance, and are small, because large weights magnify round-off; `python benchmarks/tune_pair.py --starts 50
--seed 0` computed them. `docs/performance.md` lists the gain. A rotation by 1 rad per step changes the amplitude by 3e-10
and the phase by 7e-10; with `Dopri8`, the changes are 1e-8 and 3e-8. A rotation by 3 rad per step, which only the loosest
tolerances allow, changes both by 8e-4; `Dopri8` shrinks the amplitude and this pair enlarges it.
"""

from typing import ClassVar

import diffrax

from .tuned_pair import AbstractTunedPair, tableau_of

#: Weights of the earlier stages in each stage from the second one on.
STAGES = (
    (0.0264095066184915732,),
    (-0.0951454276156460437, 0.197205113615956537),
    (0.0382723822501164349, 0.0, 0.114817146750349305),
    (0.340728385923567229, 0.0, -1.26253835950274032, 1.29391268982535148),
    (0.0471260472771719265, 0.0, 0.0, 0.224498367395226173, 0.171561106054512757),
    (0.0590440082255451129, 0.0, 0.0, 0.114071422618731564, -0.0378378059023787798, 0.0193348261944475019),
    (
        0.0365572331237326326,
        0.0,
        0.0,
        -0.112785750737816087,
        -0.0200197217913811437,
        0.264698482467943486,
        0.382401591582088885,
    ),
    (
        0.0312431119539113663,
        0.0,
        0.0,
        -0.443529080982225846,
        -0.10818930354249574,
        0.350096078879088549,
        0.737630684802208065,
        0.00787200162208728345,
    ),
    (
        0.042764965171270215,
        0.0,
        0.0,
        -2.53964965878014884,
        -0.571698691275378902,
        1.79445409889859033,
        2.82849237522023631,
        -4.96648616535426679,
        4.20195310626063492,
    ),
    (
        0.0712249803769250457,
        0.0,
        0.0,
        3.62459374291150017,
        0.496667275243315152,
        -0.576837581060020108,
        -3.50883297238221082,
        2.2736134998603225,
        -1.75656570363706242,
        0.242059382831136652,
    ),
    (
        -0.0144214661765158586,
        0.0,
        0.0,
        -3.21289854991586515,
        -0.112518252256146923,
        -0.43451245326096399,
        3.68058102755531946,
        2.0755550674528871,
        -1.19903319755159555,
        -0.202181099181946328,
        0.419428923334827252,
    ),
    (
        -0.000771650282691543097,
        0.0,
        0.0,
        -5.05354235492386614,
        -0.396102202384168035,
        0.988007249557581917,
        5.48601431176446598,
        -4.1866828800804233,
        4.11694818529066285,
        -0.440284412075300004,
        0.486413753133738266,
        0.0,
    ),
)

#: Weights of the stages in the step of eighth order, and in that of seventh order.
EIGHTH = (
    0.045186734193491599,
    0.0,
    0.0,
    0.0,
    0.0,
    0.374631675945570157,
    0.241042042205639336,
    -0.785379104914705101,
    0.842718956957207442,
    0.0661256911852675056,
    0.173343529298248974,
    -0.0395809059802784134,
    0.0819113811095585014,
)
SEVENTH = (
    0.0446709993784027482,
    0.0,
    0.0,
    0.0,
    0.0,
    0.322977089262369396,
    0.243738492583544485,
    -0.388427706120021815,
    0.47002164363416725,
    0.119780424707444228,
    0.141883617244297665,
    0.0453554393097960418,
    0.0,
)

#: Weights of the state in the middle of a step (`python benchmarks/tune_middle.py`).
MIDDLE = (
    0.009479347976717664,
    *(0.0, 0.0, 0.0, 0.0),
    0.23016890496786505,
    0.3028302838538723,
    -0.27683961877437574,
    0.25612811668493285,
    -0.005010736487838182,
    -0.05433965305652322,
    0.029596279685716185,
    -0.054512924850363444,
    0.06249999999999656,
    *(-0.0026041666666668266, -0.0026041666666666696),
)


class Oscillatory8(AbstractTunedPair):
    """A Runge-Kutta pair of orders 8 and 7 with thirteen stages, for motions that oscillate or turn.

    Functions that use Diffrax's dense output, such as `tippe.simulate` for a single run, raise a `ValueError` for this
    solver, because its dense output in Diffrax, the cubic through states and rates at both ends, is far less accurate than
    its steps. Tables and batches have a continuous extension of their own.

    **Example:**

    ```
    >>> import tippe
    >>> from nonholonomic.integration import Oscillatory8
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Viscous(0.3))
    >>> launch = tippe.Launch(0.1, 155.0)
    >>> time = tippe.inversion_time(scene, launch, t1=8.0, tolerance=1e-6, solver=Oscillatory8())
    >>> print(f"{time:.2f} s")
    5.97 s

    ```
    """

    tableau: ClassVar[diffrax.ButcherTableau] = tableau_of(STAGES, EIGHTH, SEVENTH)
    middle: ClassVar[tuple[float, ...]] = MIDDLE
