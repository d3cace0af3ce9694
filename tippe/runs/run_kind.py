"""The kinds of runs: one smooth motion, or several modes of contact and flight; and the variables of a table for
each."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Array, Int

from nonholonomic.hybrid import AbstractBatchedMode
from nonholonomic.sweeps import Variable

from ..model.scene import Scene
from ..modes import airborne, airborne_stem, airborne_stick_slip
from ..modes.sliding import modes as hybrid_modes
from ..modes.sticking import modes as stick_slip_modes


class RunKind(NamedTuple):
    """How to run a kind of scene: its status words, its counters besides steps, and its modes.

    `modes` takes (scene, problem, tolerance, last) and returns the modes and the index of each cell's first mode;
    `None` for runs of one smooth motion. `flight_state` is whether states may be those of flight, which have a separate
    layout.
    """

    words: tuple[str, ...]
    counts: tuple[str, ...]
    modes: Callable[..., tuple[tuple[AbstractBatchedMode, ...], Int[Array, " cells"]]] | None
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

#: The words of tables, in the order of the integers in files (older than `Status`).
WORDS = ("inverted", "not_inverted", "contact_lost", "failed", "jammed", "does_not_fit")

SMOOTH = RunKind(WORDS, (), None)
REVERSAL = RunKind(("reversed", "not_reversed", *WORDS[2:]), (), None)
STICK_SLIP = RunKind((*WORDS, "unresolved"), ("sticks",), stick_slip_modes)
HYBRID = RunKind((*WORDS, "unresolved"), ("hops",), hybrid_modes)
AIRBORNE = RunKind((*WORDS, "unresolved"), ("hops",), airborne.modes, flight_state=True)
ON_STEM_TOO = RunKind((*WORDS, "unresolved"), ("hops",), airborne_stem.modes, flight_state=True)
STICK_SLIP_FLY = RunKind((*WORDS, "unresolved"), ("hops", "sticks"), airborne_stick_slip.modes, flight_state=True)


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


def check_differentiable(scene: Scene[Any]) -> None:
    """Raise `ValueError` for a scene whose modes do not support derivatives."""
    if run_kind_of(scene) is STICK_SLIP_FLY:
        raise ValueError(
            "friction = SetValuedCoulomb with contact = 'hybrid' has no derivatives, because an impact may stop a slip"
        )
