"""The kinds of runs, one smooth motion or several modes of contact and flight, and the check of their energy: without a
drive, energy never grows, and it decreases by the work of friction."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.compilation.xla_cpu import compiled_setup
from nonholonomic.hybrid import AbstractBatchedMode
from nonholonomic.integration.status import Status
from nonholonomic.runs import Start

from ..model.dynamics import NO_COSINE
from ..model.launch import Launch
from ..model.scene import Scene
from ..model.top import Top
from ..modes.airborne import airborne_modes
from ..modes.airborne_ends import airborne_energy, loss
from ..modes.airborne_stem import modes_with_stem
from ..modes.airborne_stick_slip import airborne_stick_slip_modes
from ..modes.free_body import energy_in
from ..modes.sliding import hopping_modes
from ..modes.sticking import contact_energy, stick_slip_modes
from ..modes.inversion_problem import InversionProblem
from ..modes.trajectory_problem import trajectory_problem


class RunKind(NamedTuple):
    """How to run a kind of scene: its counters besides steps, and its modes.

    `modes` is a function of (scene, problem, tolerance, last) that returns the modes and the index of each cell's first
    mode; `None` for smooth runs. `energy_in` is a function of (scene, state, mode) that returns the least and the
    greatest energy [J] that the state may have. `loss` is a function of (scene, state) that returns how a run left its
    domain, as a code in `LOSSES`; `None` for runs that can only jam, because they continue when contact is lost, and the
    ball fits everywhere. `flight_state` is true if states in flight have another layout.
    """

    counts: tuple[str, ...]
    modes: Callable[..., tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"]]] | None
    energy_in: Callable[..., tuple[Float[Array, " cells"], Float[Array, " cells"]]]
    loss: Callable[..., Int[Array, " cells"]] | None
    flight_state: bool = False

    @property
    def smooth(self) -> bool:
        """Whether a run is one smooth motion."""
        return self.modes is None


#: Descriptions of the counters of a run.
COUNTED = {"hops": "flights", "sticks": "changes from slip to rolling"}


def energy_of_state(
    scene: Scene[Any], state: Float[Array, "components cells"], mode: Any
) -> tuple[Float[Array, " cells"], Float[Array, " cells"]]:
    """The least and the greatest energy [J] of a state of one smooth motion, which are the same."""
    total = scene.energy(state)
    return total, total


def loss_of_contact(scene: Scene[Any], state: Float[Array, "components cells"]) -> Int[Array, " cells"]:
    """How a contact has ended, as a code in `LOSSES`."""
    return scene.dynamics.loss(state)


SMOOTH = RunKind((), None, energy_of_state, loss_of_contact)
STICK_SLIP = RunKind(("sticks",), stick_slip_modes, contact_energy, loss_of_contact)
HYBRID = RunKind(("hops",), hopping_modes, energy_in, None)
AIRBORNE = RunKind(("hops",), airborne_modes, airborne_energy, loss, True)
ON_STEM_TOO = AIRBORNE._replace(modes=modes_with_stem)
STICK_SLIP_FLY = AIRBORNE._replace(counts=("hops", "sticks"), modes=airborne_stick_slip_modes)


def run_kind_of(scene: Scene[Any]) -> RunKind:
    """The run kind of a scene."""
    hybrid = scene.contact == "hybrid"
    if scene.friction.set_valued:
        return STICK_SLIP_FLY if hybrid else STICK_SLIP
    if not hybrid:
        return SMOOTH
    if scene.flies_in_closed_form:
        return HYBRID
    return AIRBORNE if scene.body.stem is None else ON_STEM_TOO


def flight_modes(scene: Scene[Top], launch: Launch, tolerance: Any, cells: int = 1) -> Start:
    """The modes of launches of a hybrid scene, with their path, rotation and work; the index of each first mode; and the
    initial states."""
    problem, modes = _start_of_flights(scene, launch, cells), run_kind_of(scene).modes
    assert modes is not None
    return (*modes(scene, problem, tolerance, last=False, with_quadratures=True), problem.states)


@compiled_setup
def _start_of_flights(scene: Scene[Top], launch: Launch, cells: int) -> InversionProblem:
    """The launches, with the passive quadratures."""
    state, scales = trajectory_problem((scene, launch), cells).start()
    if scene.flies_in_closed_form:
        # The path is that of the centre of mass.
        place = state[8:10] - scene.body.offset * state[2:4]
        state = jnp.concatenate([state[:8], place, state[10:]])
    return InversionProblem(scene.dynamics, jnp.asarray(NO_COSINE), state, scales)


def why_unresolved(kind: RunKind) -> str:
    """The reasons why a run of this kind may be unresolved."""
    grown = (
        "its energy has grown by more than the tolerance allows, although nothing drives the top: the law of friction pushes "
        "it, or the arena's heights do not fit its normals"
    )
    reasons = "the model does not determine the motion from there on, or the mode changed too often, or"
    return grown if kind.smooth else f"{reasons} {grown}; tippe.simulate states which"


#: Largest allowed error of the energy, relative to its size, divided by the tolerance. Flights over ripples and in a
#: spheroid stay below 1e-4 of this value; a faulty landing away from the arena once left 8e4 times this value.
BALANCED = 1e4


def allowance(scene: Scene[Any], energy: Any, tolerance: Any) -> Any:
    """The allowed error [J] of an energy of the given size [J] at a tolerance."""
    return BALANCED * tolerance * (abs(energy) + scene.body.mass * scene.gravity * scene.body.size)


def if_balanced(run: Any, tolerance: float | Float[Array, ""]) -> Any:
    """A single run, with the status "unresolved" if its energy has grown or does not balance the work of friction and
    impacts."""
    energy = np.asarray(run.energy)
    limit = float(allowance(run.scene, np.max(np.abs(energy)), tolerance))
    balanced = run.stats["energy_residual"] <= limit and energy[-1] <= energy[0] + limit
    if balanced or run.status == Status.FAILED.word:
        return run
    return dataclasses.replace(run, status=Status.UNRESOLVED.word)


def why_unbalanced(run: Any) -> str:
    """The reason why such a run is "unresolved"."""
    energy = np.asarray(run.energy)
    if (gain := energy[-1] - energy[0]) > run.stats["energy_residual"]:
        return f"the energy has grown by {gain:.1e} J, although nothing drives the top"
    return f"the energy residual of {run.stats['energy_residual']:.1e} J is beyond what the tolerance allows"
