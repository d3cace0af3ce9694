"""An explicit Runge-Kutta pair of orders 8 and 7 for stiff friction.

Coulomb friction with a small slip speed makes the slip decay fast, and stability then limits the steps of an explicit method:
of `Oscillatory8` to 5.5 times the time constant of the decay, of this pair to 16.5 times. No polynomial of its
degree reaches beyond 17.2. In smooth motions, its errors are two to thirty times those of `Oscillatory8`.
`python benchmarks/tune_stability.py` computed the weights.
"""

from typing import ClassVar

import diffrax

from .tuned_pair import AbstractTunedPair, tableau_of

#: Weights of the earlier stages in each stage from the second one on.
STAGES = (
    (0.00252736177617905169,),
    (-0.988240718963164233, 1.06149057500453514),
    (0.0274686960155141151, 0.0, 0.082406088046542314),
    (0.846856143800861827, 0.0, -3.25190284351948522, 2.76825448885013348),
    (0.0151674799573641144, 0.0, 0.0, 0.221780152666421759, 0.218637314302734448),
    (0.0413676525926522515, 0.0, 0.0, 0.118043053031700734, -0.00461223629238015093, 0.00229117004924214501),
    (
        0.659747413002222283,
        0.0,
        0.0,
        -3.88876058582011108,
        -0.964088931304317831,
        0.613115244501515666,
        4.12848973176902767,
    ),
    (
        0.860325040688847076,
        0.0,
        0.0,
        -5.22362777496570807,
        -1.4323068256681224,
        0.874570165738170924,
        5.50123479411500682,
        0.00427635648874000011,
    ),
    (
        0.941643353390386517,
        0.0,
        0.0,
        -6.03256085600045822,
        -2.1655640643752192,
        1.63728577742262238,
        6.48167391499474643,
        -0.701090973820645336,
        0.538648325198769151,
    ),
    (
        -0.421345625436220839,
        0.0,
        0.0,
        2.79431777624126365,
        0.403266798141119986,
        0.165481058238752921,
        -2.43719734391897491,
        1.38321826080213528,
        -1.55152648437205753,
        0.486829247899323247,
    ),
    (
        1.07377662236377369,
        0.0,
        0.0,
        -5.98561879773314054,
        -0.241581504645284828,
        -1.45557665765452771,
        5.91169813967516156,
        1.14358316375852143,
        1.14599960217781627,
        -1.38441876339070702,
        0.792138195448386595,
    ),
    (
        1.09862600510965502,
        0.0,
        0.0,
        -6.14720262652906779,
        -0.310216198430492363,
        -1.22743951448390898,
        6.07319551144538572,
        0.250037686855820229,
        1.9660247214491835,
        -1.50925561551232801,
        0.806230030095752337,
        0.0,
    ),
)

#: Weights of the stages in the step of eighth order, and in that of seventh order.
EIGHTH = (
    0.0460998013113424129,
    0.0,
    0.0,
    0.0,
    0.0,
    0.51732802908461295,
    0.243628242721677352,
    -1.34362940463667213,
    1.45707533729580963,
    -0.304424563360959355,
    0.335719545258809093,
    -1.45793483726484796,
    1.50613784959022823,
)
SEVENTH = (
    0.0440664000538927361,
    0.0,
    0.0,
    0.0,
    0.0,
    0.179822548883546401,
    0.254871866525446134,
    0.650789999079107062,
    -0.569060911346897846,
    0.143315783215906684,
    0.242109337290808663,
    0.0540849762981901808,
    0.0,
)

#: Weights of the state in the middle of a step (`python benchmarks/tune_middle.py`).
MIDDLE = (
    0.010341912126779804,
    *(0.0, 0.0, 0.0, 0.0),
    0.2044173791372304,
    0.3080452726436807,
    0.08831983611411266,
    -0.16810016874800165,
    0.11964066177996473,
    -0.09836571479302787,
    1.3338483574940543,
    -1.3606475357545644,
    0.062499999999771384,
    *(-0.0026041666666951776, -0.002604166666659088),
)


class Stabilized8(AbstractTunedPair):
    """A Runge-Kutta pair of orders 8 and 7 with thirteen stages, for Coulomb friction with slip speeds of 3e-3 to 1e-4 m/s.

    Functions that use Diffrax's dense output, such as `tippe.simulate` for a single run, raise a `ValueError` for this
    solver, as for `Oscillatory8`.

    **Example:**

    ```
    >>> import tippe
    >>> from nonholonomic.integration import Stabilized8
    >>> top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    >>> scene = tippe.Scene(top, friction=tippe.Coulomb(mu=0.3, slip_speed=1e-3))
    >>> options = {"t1": 0.5, "angle": 1.0, "tolerance": 1e-6, "solver": Stabilized8(), "progress": False}
    >>> table = tippe.inversion_table(scene, theta=[0.2, 0.3], spin=150.0, **options)
    >>> print(table.end_theta.round(4), table.steps.mean() < 500.0)  # Oscillatory8 needs more than 500 steps
    [0.0709 0.1131] True

    ```
    """

    tableau: ClassVar[diffrax.ButcherTableau] = tableau_of(STAGES, EIGHTH, SEVENTH)
    middle: ClassVar[tuple[float, ...]] = MIDDLE
