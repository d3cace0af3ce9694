"""The kinds of runs: one smooth motion, or several modes of contact and flight; and the variables of a table for
each."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Float, Int

from nonholonomic.hybrid import AbstractBatchedMode
from nonholonomic.sweeps import Variable

from ..model.scene import Scene
from ..modes import airborne, airborne_ends, airborne_stem, airborne_stick_slip, free_body, sliding, sticking


class RunKind(NamedTuple):
    """How to run a kind of scene: its status words, its counters besides steps, and its modes.

    `modes` is a function of (scene, problem, tolerance, last) that returns the modes and the index of each cell's first
    mode; `None` for smooth runs. `energy_in` is a function of (scene, state, mode) that returns the least and the
    greatest energy [J] that the state may have. `flight_state` is true if states in flight have another layout.
    """

    words: tuple[str, ...]
    counts: tuple[str, ...]
    modes: Callable[..., tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"]]] | None
    energy_in: Callable[..., tuple[Float[Array, " cells"], Float[Array, " cells"]]]
    flight_state: bool = False

    @property
    def smooth(self) -> bool:
        """Whether a run is one smooth motion."""
        return self.modes is None

    @property
    def variables(self) -> dict[str, Variable]:
        """The table's variables in addition to the times."""
        counts = ("steps", "rejected", *self.counts)
        return {
            "status": Variable("1", np.int8, self.words, long_name="how the run ended"),
            "end_time": Variable("s", np.float64, long_name="end of the run"),
            "end_theta": Variable("rad", np.float64, long_name="θ at the end of the run"),
            **{name: Variable("1", np.int64, long_name=COUNTED[name]) for name in counts},
        }


#: Descriptions of the counters of a run.
COUNTED = {"steps": "steps", "rejected": "rejected steps", "hops": "flights", "sticks": "changes from slip to rolling"}


def energy_of_state(
    scene: Scene[Any], state: Float[Array, "components cells"], mode: Any
) -> tuple[Float[Array, " cells"], Float[Array, " cells"]]:
    """The least and the greatest energy [J] of a state of one smooth motion, which are the same."""
    total = scene.energy(state)
    return total, total


#: The words of tables, in the order of the integers in their files, which is older than `Status`.
WORDS = ("inverted", "not_inverted", "contact_lost", "failed", "jammed", "does_not_fit", "unresolved")

SMOOTH = RunKind(WORDS, (), None, energy_of_state)
REVERSAL = RunKind(("reversed", "not_reversed", *WORDS[2:]), (), None, energy_of_state)
STICK_SLIP = RunKind(WORDS, ("sticks",), sticking.modes, sticking.energy_in)
STICK_SLIP_REVERSAL = STICK_SLIP._replace(words=REVERSAL.words)
HYBRID = RunKind(WORDS, ("hops",), sliding.modes, free_body.energy_in)
AIRBORNE = RunKind(WORDS, ("hops",), airborne.modes, airborne_ends.energy_in, flight_state=True)
ON_STEM_TOO = RunKind(WORDS, ("hops",), airborne_stem.modes, airborne_ends.energy_in, flight_state=True)
STICK_SLIP_FLY = RunKind(
    WORDS, ("hops", "sticks"), airborne_stick_slip.modes, airborne_ends.energy_in, flight_state=True
)


def reversal_kind_of(scene: Scene[Any]) -> RunKind:
    """The run kind of a scene until the spin about the normal reverses."""
    return STICK_SLIP_REVERSAL if scene.friction.set_valued else REVERSAL


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


def why_unresolved(kind: RunKind) -> str:
    """The reasons why a run of this kind may be unresolved."""
    grown = (
        "its energy has grown by more than the tolerance allows, although nothing drives the top: the law of friction pushes "
        "it, or the arena's heights do not fit its normals"
    )
    reasons = "the model does not determine the motion from there on, or the mode changed too often, or"
    return grown if kind.smooth else f"{reasons} {grown}; tippe.simulate states which"


def check_differentiable(scene: Scene[Any]) -> None:
    """Raise `ValueError` for a scene whose modes do not support derivatives."""
    if run_kind_of(scene) is STICK_SLIP_FLY:
        raise ValueError(
            "friction = SetValuedCoulomb with contact = 'hybrid' has no derivatives, because an impact may stop a slip"
        )
