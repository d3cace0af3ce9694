"""Explicit Runge-Kutta methods: one step of many lanes by the tableau of any such solver of Diffrax, and two pairs of orders 8
and 7 whose free weights are tuned to a kind of motion.

The pairs have the thirteen stages, and all simplifying assumptions, of Prince and Dormand's pair RK8(7)13M (High order
embedded Runge-Kutta formulae, J. Comput. Appl. Math. 7, 1981), which is Diffrax's `Dopri8`. These assumptions leave ten
coefficients free. Prince and Dormand chose them for a small error in ninth order, for any field; `Oscillatory8` and
`Stabilized8` choose them for other purposes.

A continuous extension of order 7 needs no more stages, only the second derivatives at both ends
(`samples.py`).
"""

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import ClassVar, NamedTuple, TypeVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..compilation.xla_cpu import current_platform, traced_once, written_by_component, written_in_place
from ..text import shown

Lanes = Float[Array, "*lanes"]
States = Float[Array, "components *lanes"]
#: A state as one array, or as a tuple of its components.
Components = States | tuple[Lanes, ...]
Mask = Bool[Array, "*lanes"]
Integers = Int[Array, "*lanes"]
Stages = Float[Array, "stages components *lanes"]
History = Float[Array, "places margins *lanes"]

#: What a loop carries from one round to the next.
Carry = TypeVar("Carry")


class Step(NamedTuple):
    """The result of a trial step.

    - `state`, `rate`: the state at the end, and the field there; `error`: the estimated error.
    - `margin`: the least of the margins and the event function at the end.
    - `first_negative`: time of the first stage at which a margin or the event function was negative, as a fraction of
      the step; 2 if there was none.
    - `margins`: all margins at `watched_places` of the step; `None` if there are none.
    - `rates`: the field at all stages; `middle`: the state in the middle of the step, to fifth order.
    - `stages`: the field at the inner stages (`inner_stages`) and at the end, in one array whose memory the next step reuses.
    """

    state: States
    rate: States
    error: States
    margin: Lanes
    first_negative: Lanes
    margins: History | None
    rates: Sequence[States]
    middle: States
    stages: Stages | None


def explicit_tableau(solver: diffrax.AbstractSolver) -> diffrax.ButcherTableau:
    """The tableau of an explicit, embedded Runge-Kutta solver of Diffrax.

    **Raises:** `ValueError` for any other solver.

    **Example:**

    >>> import diffrax
    >>> from nonholonomic.integration import explicit_tableau
    >>> explicit_tableau(diffrax.Dopri8()).num_stages
    14
    """
    tableau = getattr(solver, "tableau", None)
    if not isinstance(solver, diffrax.AbstractERK) or not isinstance(tableau, diffrax.ButcherTableau):
        raise ValueError(
            f"solver = {shown(solver)} must be an explicit Runge-Kutta solver of Diffrax, such as Dopri8()"
        )
    return tableau


def explicit_step(
    tableau: diffrax.ButcherTableau,
    field: Callable[[Lanes, States], States],
    margins: Callable[[Lanes, States], tuple[Lanes, ...]],
    crossing: Callable[[States, States], Lanes | None],
    time: Lanes,
    state: States,
    rate: States,
    length: Lanes,
    margins_before: Float[Array, "margins *lanes"] | None,
    stages: Stages,
    looks: Sequence[int],
) -> Step:
    """Try one step in every lane.

    The stages are computed in a loop, so that the field is compiled once and not once per stage. In one kernel the
    loop runs as fast as unrolled stages, and compiles in half the time.

    **Arguments:**

    - `tableau`: the method.
    - `field`: (time [s], state) -> rate of the state.
    - `margins`, `crossing`: a function of (time, state) that returns the margins, and a function of (state, rate) that
      returns the event function or `None`. Their values, one per lane, should stay positive. Both are
      evaluated at the end of the step and at the stages `looks`. The margins, which may need the whole state, are
      evaluated during these stages. The event function, which may need few components, is evaluated after all stages.
    - `time`, `state`, `rate`: time and state at the start of the step, and the field there.
    - `length`: length of the step [s], one per lane.
    - `margins_before`: the margins at the start; `None` if there are none.
    - `stages`: memory for the stages (`memory_for_stages`), whose numbers do not matter. A loop over steps passes it
      on from step to step: clearing new memory would take a tenth of the time of a step.

    **Returns:** a `Step`.
    """
    field, crossing = traced_once(field, time + length, state), traced_once(crossing, state, rate)
    inner = inner_stages(tableau)
    # The end of the step is the last stage.
    weights, checked = [*tableau.a_lower[:inner], tableau.b_sol[: 1 + inner]], [*looks, inner]
    places = jnp.asarray([*tableau.c[:inner], 1.0])
    is_checked = jnp.asarray(np.isin(np.arange(1 + inner), checked))
    rows = jnp.asarray(np.searchsorted(checked, np.arange(1 + inner)) + 1)

    def do(
        stage: Int[Array, ""], carry: tuple[States, Stages, History | None]
    ) -> tuple[States, Stages, History | None]:
        _, stages, history = carry
        trial = moved_state(stage, weights, state, length, stages, first=rate)
        stage_time = time + places[stage] * length

        def check(history: History) -> History:
            return written_in_place(history, jnp.stack(margins(stage_time, trial)), at=rows[stage])

        # A branch, because margins in every stage would add a tenth to the cost of a step of a top in a cylinder.
        history = None if history is None else jax.lax.cond(is_checked[stage], check, lambda history: history, history)
        return trial, written_by_component(stages, field(stage_time, trial), at=stage), history

    history = None
    if margins_before is not None:
        margins = traced_once(margins, time + length, state)
        history = jnp.zeros((2 + len(looks), *margins_before.shape), margins_before.dtype)
        history = written_in_place(history, margins_before, at=jnp.zeros((), int))
    end, stages, history = over_stages(1 + inner, do, (state, stages, history))
    rates = [rate, *jnp.unstack(stages)]
    last_rate = rates[-1]
    least = None if history is None else jnp.min(history[-1], axis=0)
    margin_at_end = jax.lax.optimization_barrier(lesser(least, crossing(end, last_rate), length))
    # Read from the last version of `history`: if an earlier one were still in use, the compiler would copy it.
    first_negative = jnp.full_like(length, 2.0)
    for row, stage in enumerate(looks, start=1):
        trial = state + length * weighted_sum(tableau.a_lower[stage], rates[: stage + 1])
        least = None if history is None else jnp.min(history[row], axis=0)
        margin = lesser(least, crossing(trial, rates[stage + 1]), length)
        first_negative = jnp.minimum(first_negative, jnp.where(margin < 0.0, tableau.c[stage], 2.0))
    middle = state + length * weighted_sum(middle_weights(tableau), rates)
    rates = rates if tableau.fsal else rates[:-1]
    error = length * weighted_sum(tableau.b_error, rates)
    return Step(end, last_rate, error, margin_at_end, first_negative, history, rates, middle, stages)


def inner_stages(tableau: diffrax.ButcherTableau) -> int:
    """Number of stages after the first, without a last stage that is the end of the step."""
    return len(tableau.c) - 1 if tableau.fsal else len(tableau.c)


def middle_weights(tableau: diffrax.ButcherTableau) -> tuple[float, ...]:
    """Weights of the rates at the stages and at the end of a step in the state in its middle: the smallest that meet the
    order conditions (Hairer, Norsett and Wanner, Solving ODEs I, section II.2) to the fifth order, or to the highest that
    the stages allow.
    """
    inner = inner_stages(tableau)
    a = np.zeros((1 + inner + 1, 1 + inner + 1))
    for k, row in enumerate((*tableau.a_lower[:inner], tableau.b_sol[: 1 + inner]), start=1):
        a[k, : len(row)] = row
    ones = np.ones(len(a))
    c = a @ ones
    # The elementary weights of the rooted trees, with the order and the density of each.
    trees = [(ones, 1, 1), (c, 2, 2), (c**2, 3, 3), (a @ c, 3, 6), (c**3, 4, 4), (c * (a @ c), 4, 8), (a @ c**2, 4, 12)]
    trees += [(a @ a @ c, 4, 24), (c**4, 5, 5), (c**2 * (a @ c), 5, 10), ((a @ c) ** 2, 5, 20), (c * (a @ c**2), 5, 15)]
    trees += [(c * (a @ a @ c), 5, 30), (a @ c**3, 5, 20), (a @ (c * (a @ c)), 5, 40), (a @ a @ c**2, 5, 60)]
    trees += [(a @ a @ a @ c, 5, 120)]
    for highest in (5, 4, 3, 2):
        conditions = np.array([tree for tree, order, _ in trees if order <= highest])
        values = np.array([0.5**order / density for _, order, density in trees if order <= highest])
        weights = np.linalg.lstsq(conditions, values, rcond=1e-12)[0]
        if np.abs(conditions @ weights - values).max() < 1e-12:
            break
    return tuple(np.where(np.abs(weights) < 1e-14, 0.0, weights).tolist())


def memory_for_stages(tableau: diffrax.ButcherTableau, state: States) -> Stages:
    """Memory in which `explicit_step` stores the field at the stages after the first, and at the end of the step."""
    return jnp.zeros((1 + inner_stages(tableau), *state.shape), state.dtype)


def watched_places(tableau: diffrax.ButcherTableau, looks: Sequence[int]) -> Float[np.ndarray, " places"]:
    """The fractions of a step at which its margins are known: its start, the stages `looks`, and its end."""
    return np.array([0.0, *(tableau.c[stage] for stage in looks), 1.0])


def lesser(margin: Lanes | None, crossing: Lanes | None, like: Lanes) -> Lanes:
    """The lesser of two numbers per lane, either of which may be `None`; 1 if both are."""
    if margin is None:
        return jnp.ones_like(like) if crossing is None else crossing
    return margin if crossing is None else jnp.minimum(crossing, margin)


def over_stages(stages: int, do: Callable[[Int[Array, ""], Carry], Carry], start: Carry) -> Carry:
    """Loop over the stages and return the carry; on an accelerator, which would wait for the host at every branch, the
    loop is unrolled.
    """
    return jax.lax.fori_loop(0, stages, do, start, unroll=current_platform() != "cpu")


def stages_to_look(fractions: Float[np.ndarray, " stages"]) -> list[int]:
    """The stages nearest to 1/4, 1/2 and 3/4 of the step, where the inside of the step is checked."""
    inner = [stage for stage, fraction in enumerate(fractions) if 0.0 < fraction < 1.0]
    return sorted({min(inner, key=lambda k: abs(fractions[k] - part)) for part in (0.25, 0.5, 0.75) if inner})


def weighted_sum(weights: Iterable[float], rates: Sequence[States]) -> States:
    """Weighted sum of the rates, without those of weight 0."""
    total = None
    for weight, rate in zip(weights, rates, strict=True):
        if weight != 0.0:
            term = float(weight) * rate
            total = term if total is None else total + term
    return jnp.zeros_like(rates[0]) if total is None else total


def moved_state(
    stage: Int[Array, ""],
    rows: Iterable[Float[np.ndarray, " _"]],
    state: States,
    length: Lanes,
    rates: Stages,
    first: States | None = None,
) -> States:
    """The state moved along the rates of the earlier stages, with the weights of a stage. Every stage is a branch of
    its own, so that its weights are constants, of which many are 0.

    **Arguments:** `first`: the rate at the first stage, if `rates` begins with the second.
    """
    before = [] if first is None else [first]

    def moved(row: Float[np.ndarray, " before"], rates: Stages) -> States:
        return state + length * weighted_sum(row, [*before, *(rates[k] for k in range(len(row) - len(before)))])

    return jax.lax.switch(stage, [functools.partial(moved, row) for row in rows], rates)


def scaled_error(
    error: States, old_state: States, new_state: States, rtol: Float[Array, ""], atol: States, n_blocks: int
) -> Lanes:
    """Error in units of the tolerance: the greatest root mean square among the blocks of the state (Diffrax's norm and
    scale).

    The squares are added one by one: XLA compiles a sum over an axis of more than eight components lane by lane, which
    took half of the time of a run with twelve components.
    """
    ratio = error / (atol + rtol * jnp.maximum(jnp.abs(old_state), jnp.abs(new_state)))
    squares, size = [component * component for component in ratio], ratio.shape[0] // n_blocks
    means = [functools.reduce(operator.add, squares[k * size : (k + 1) * size]) / size for k in range(n_blocks)]
    return jnp.sqrt(functools.reduce(jnp.maximum, means))


def inverse_root(value: Lanes, order: int) -> Lanes:
    """`value**(-1/order)`; by square roots alone where the order is a power of 2, because `pow` costs twenty of them."""
    if order & (order - 1) == 0:
        while order > 1:
            value, order = jnp.sqrt(value), order // 2
        return 1.0 / value
    return value ** (-1.0 / order)


def first_rate_and_length(
    field: Callable[[Lanes, States], States],
    time: Lanes,
    state: States,
    order: int,
    rtol: Float[Array, ""],
    atol: States,
    n_blocks: int,
) -> tuple[States, Lanes]:
    """The field at the start, and the length of the first step [s] (Hairer, Norsett and Wanner, Solving ODEs I, section
    II.4), in the motion's own unit of time.

    The comparison of |y'| with |y''| in their formula depends on the unit of time; Diffrax uses seconds. Here the unit
    is |y|/|y'|, so that motions that differ only in scale are integrated alike. If the state has several blocks
    (`n_blocks`), the first one counts.
    """
    scale = atol + jnp.abs(state) * rtol
    size = state.shape[0] // n_blocks

    def measure(vector: States) -> Lanes:
        return jnp.sqrt(jnp.mean((vector / scale)[:size] ** 2, axis=0))

    magnitude = measure(state)

    def evaluate(count: Int[Array, ""], carry: tuple[Stages, Lanes]) -> tuple[Stages, Lanes]:
        rates, unit = carry
        trial = 0.01 * unit
        rates = written_in_place(rates, field(time + trial, state + trial * rates[0]), at=count)
        unit = magnitude / measure(rates[0])
        # A state at rest has no unit of time of its own; longer units would overflow below.
        at_rest = (magnitude < 1e-5) | ~(unit < 1e15)
        return rates, jnp.where(at_rest, 1e-4, unit)

    # At the start, and after a short step along the first rate; in a loop, so that the field is compiled once.
    start = jnp.zeros((2, *state.shape), state.dtype), jnp.zeros_like(state[0])
    (rate, later_rate), unit = over_stages(2, evaluate, start)
    slope = measure(rate)
    bend = measure(later_rate - rate) / (0.01 * unit)
    max_slope = unit * jnp.maximum(slope, unit * bend)
    fraction = jnp.where(max_slope <= 1e-15, 0.01, inverse_root(jnp.maximum(max_slope, 1e-15) * 100.0, order))
    return rate, unit * jnp.minimum(1.0, fraction)


# Pairs of orders 8 and 7.

#: The error of a step is estimated by this factor times the difference between the two orders. With 2, smooth motions
#: take about as many steps as with Prince and Dormand's pair at the same tolerance, and err less.
CAUTION = 2.0


class AbstractTunedPair(diffrax.AbstractERK):
    """A pair of orders 8 and 7; `middle`: weights of the state in the middle of a step, of the stages, the field at the
    end, and the second derivatives at both ends. They satisfy the order conditions up to order 7.

    Its dense output in Diffrax is the cubic through states and rates at both ends (`Settings.for_single_runs`).
    """

    middle: ClassVar[tuple[float, ...]]
    interpolation_cls: ClassVar[Callable] = diffrax.ThirdOrderHermitePolynomialInterpolation.from_k

    def order(self, terms: object) -> int:
        return 8


def tableau_of(
    stages: Sequence[Sequence[float]], eighth: Sequence[float], seventh: Sequence[float]
) -> diffrax.ButcherTableau:
    """The tableau of a pair.

    **Arguments:** `stages`: weights of the earlier stages in each stage from the second one on; `eighth`, `seventh`: weights
    of the stages in the step of eighth and of seventh order.
    """
    return diffrax.ButcherTableau(
        a_lower=tuple(map(np.array, (*stages, eighth))),
        b_sol=np.array([*eighth, 0.0]),
        b_error=np.array([*(CAUTION * np.subtract(eighth, seventh)), 0.0]),
        # The places of the stages in the step, and its end, where the next step begins.
        c=np.array([*(sum(row) for row in stages), 1.0]),
    )


# An explicit Runge-Kutta pair of orders 8 and 7 for motions that oscillate or rotate, the default of ensemble solves.
#
# Its free weights minimise the error of a step along the motions of tops and strollers, for lengths at which the error is
# about the tolerance, and are small, because large weights magnify round-off; `python benchmarks/tune_pair.py --starts 50
# --seed 0` computed them. `docs/performance.md` lists the gain. A rotation by 1 rad per step changes the amplitude by 3e-10
# and the phase by 7e-10; with `Dopri8`, the changes are 1e-8 and 3e-8. A rotation by 3 rad per step, which only the loosest
# tolerances allow, changes both by 8e-4; `Dopri8` shrinks the amplitude and this pair enlarges it.

# fmt: off
#: Weights of the earlier stages in each stage from the second one on.
OSCILLATORY_STAGES = (
    (0.0264095066184915732,),
    (-0.0951454276156460437, 0.197205113615956537),
    (0.0382723822501164349, 0.0, 0.114817146750349305),
    (0.340728385923567229, 0.0, -1.26253835950274032, 1.29391268982535148),
    (0.0471260472771719265, 0.0, 0.0, 0.224498367395226173, 0.171561106054512757),
    (0.0590440082255451129, 0.0, 0.0, 0.114071422618731564, -0.0378378059023787798, 0.0193348261944475019),
    (0.0365572331237326326, 0.0, 0.0, -0.112785750737816087, -0.0200197217913811437, 0.264698482467943486,
     0.382401591582088885),
    (0.0312431119539113663, 0.0, 0.0, -0.443529080982225846, -0.10818930354249574, 0.350096078879088549,
     0.737630684802208065, 0.00787200162208728345),
    (0.042764965171270215, 0.0, 0.0, -2.53964965878014884, -0.571698691275378902, 1.79445409889859033,
     2.82849237522023631, -4.96648616535426679, 4.20195310626063492),
    (0.0712249803769250457, 0.0, 0.0, 3.62459374291150017, 0.496667275243315152, -0.576837581060020108,
     -3.50883297238221082, 2.2736134998603225, -1.75656570363706242, 0.242059382831136652),
    (-0.0144214661765158586, 0.0, 0.0, -3.21289854991586515, -0.112518252256146923, -0.43451245326096399,
     3.68058102755531946, 2.0755550674528871, -1.19903319755159555, -0.202181099181946328, 0.419428923334827252),
    (-0.000771650282691543097, 0.0, 0.0, -5.05354235492386614, -0.396102202384168035, 0.988007249557581917,
     5.48601431176446598, -4.1866828800804233, 4.11694818529066285, -0.440284412075300004, 0.486413753133738266, 0.0),
)

#: Weights of the stages in the step of eighth order, and in that of seventh order.
OSCILLATORY_EIGHTH = (
    0.045186734193491599, 0.0, 0.0, 0.0, 0.0, 0.374631675945570157, 0.241042042205639336, -0.785379104914705101,
    0.842718956957207442, 0.0661256911852675056, 0.173343529298248974, -0.0395809059802784134, 0.0819113811095585014,
)
OSCILLATORY_SEVENTH = (
    0.0446709993784027482, 0.0, 0.0, 0.0, 0.0, 0.322977089262369396, 0.243738492583544485, -0.388427706120021815,
    0.47002164363416725, 0.119780424707444228, 0.141883617244297665, 0.0453554393097960418, 0.0,
)

#: Weights of the state in the middle of a step (`python benchmarks/tune_middle.py`).
OSCILLATORY_MIDDLE = (
    0.009479347976717664, 0.0, 0.0, 0.0, 0.0, 0.23016890496786505, 0.3028302838538723, -0.27683961877437574,
    0.25612811668493285, -0.005010736487838182, -0.05433965305652322, 0.029596279685716185, -0.054512924850363444,
    0.06249999999999656, -0.0026041666666668266, -0.0026041666666666696,
)
# fmt: on


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

    tableau: ClassVar[diffrax.ButcherTableau] = tableau_of(OSCILLATORY_STAGES, OSCILLATORY_EIGHTH, OSCILLATORY_SEVENTH)
    middle: ClassVar[tuple[float, ...]] = OSCILLATORY_MIDDLE


# An explicit Runge-Kutta pair of orders 8 and 7 for stiff friction.
#
# Coulomb friction with a small slip speed makes the slip decay fast, and stability then limits the steps of an explicit method:
# of `Oscillatory8` to 5.5 times the time constant of the decay, of this pair to 16.5 times. No polynomial of its
# degree reaches beyond 17.2. In smooth motions, its errors are two to thirty times those of `Oscillatory8`.
# `python benchmarks/tune_stability.py` computed the weights.

# fmt: off
#: Weights of the earlier stages in each stage from the second one on.
STABILIZED_STAGES = (
    (0.00252736177617905169,),
    (-0.988240718963164233, 1.06149057500453514),
    (0.0274686960155141151, 0.0, 0.082406088046542314),
    (0.846856143800861827, 0.0, -3.25190284351948522, 2.76825448885013348),
    (0.0151674799573641144, 0.0, 0.0, 0.221780152666421759, 0.218637314302734448),
    (0.0413676525926522515, 0.0, 0.0, 0.118043053031700734, -0.00461223629238015093, 0.00229117004924214501),
    (0.659747413002222283, 0.0, 0.0, -3.88876058582011108, -0.964088931304317831, 0.613115244501515666,
     4.12848973176902767),
    (0.860325040688847076, 0.0, 0.0, -5.22362777496570807, -1.4323068256681224, 0.874570165738170924,
     5.50123479411500682, 0.00427635648874000011),
    (0.941643353390386517, 0.0, 0.0, -6.03256085600045822, -2.1655640643752192, 1.63728577742262238,
     6.48167391499474643, -0.701090973820645336, 0.538648325198769151),
    (-0.421345625436220839, 0.0, 0.0, 2.79431777624126365, 0.403266798141119986, 0.165481058238752921,
     -2.43719734391897491, 1.38321826080213528, -1.55152648437205753, 0.486829247899323247),
    (1.07377662236377369, 0.0, 0.0, -5.98561879773314054, -0.241581504645284828, -1.45557665765452771,
     5.91169813967516156, 1.14358316375852143, 1.14599960217781627, -1.38441876339070702, 0.792138195448386595),
    (1.09862600510965502, 0.0, 0.0, -6.14720262652906779, -0.310216198430492363, -1.22743951448390898,
     6.07319551144538572, 0.250037686855820229, 1.9660247214491835, -1.50925561551232801, 0.806230030095752337, 0.0),
)

#: Weights of the stages in the step of eighth order, and in that of seventh order.
STABILIZED_EIGHTH = (
    0.0460998013113424129, 0.0, 0.0, 0.0, 0.0, 0.51732802908461295, 0.243628242721677352, -1.34362940463667213,
    1.45707533729580963, -0.304424563360959355, 0.335719545258809093, -1.45793483726484796, 1.50613784959022823,
)
STABILIZED_SEVENTH = (
    0.0440664000538927361, 0.0, 0.0, 0.0, 0.0, 0.179822548883546401, 0.254871866525446134, 0.650789999079107062,
    -0.569060911346897846, 0.143315783215906684, 0.242109337290808663, 0.0540849762981901808, 0.0,
)

#: Weights of the state in the middle of a step (`python benchmarks/tune_middle.py`).
STABILIZED_MIDDLE = (
    0.010341912126779804, 0.0, 0.0, 0.0, 0.0, 0.2044173791372304, 0.3080452726436807, 0.08831983611411266,
    -0.16810016874800165, 0.11964066177996473, -0.09836571479302787, 1.3338483574940543, -1.3606475357545644,
    0.062499999999771384, -0.0026041666666951776, -0.002604166666659088,
)
# fmt: on


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

    tableau: ClassVar[diffrax.ButcherTableau] = tableau_of(STABILIZED_STAGES, STABILIZED_EIGHTH, STABILIZED_SEVENTH)
    middle: ClassVar[tuple[float, ...]] = STABILIZED_MIDDLE
