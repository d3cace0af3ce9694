"""How the cells of a table are run: the kinds of scene, and the variables of each."""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from nonholonomic.integration import (
    FAILED,
    GUARD_LOST,
    UNRESOLVED,
    Journey,
    Outcome,
    compiled_march,
    lanes_for,
    march_by_diffrax,
)
from nonholonomic.parameters import with_numbers
from nonholonomic.sweeps import Variable

from .inversion import ABSOLUTE, InversionProblem, is_inverted
from .phases.flight_cells import ride as ride_with_flights
from .phases.stick_slip_cells import ride as ride_with_sticking
from .scene import Scene
from .sensitivities import slopes_of_cells


class Driver(NamedTuple):
    """How the runs of a kind of scene are computed: the words of their status, what is counted besides steps, and a function.

    `ride` takes (scene, problem, t1, tolerance, last, solver, count); `None` for runs of one smooth motion.
    """

    words: tuple[str, ...]
    counts: tuple[str, ...]
    ride: Callable[..., Journey] | None

    @property
    def smooth(self) -> bool:
        """Whether a run is one smooth motion."""
        return self.ride is None

    @property
    def variables(self) -> dict[str, Variable]:
        """The table's variables."""
        found = {"time": Variable("s", np.float64), "status": Variable("1", np.int8, self.words)}
        found |= {"end_time": Variable("s", np.float64), "end_theta": Variable("rad", np.float64)}
        return found | {name: Variable("1", np.int64) for name in ("steps", "rejected", *self.counts)}


# Compiled once for all blocks.
_jams = eqx.filter_jit(lambda dynamics, state: dynamics.jams(state))

WORDS = ("inverted", "not_inverted", "contact_lost", "failed", "jammed")
SMOOTH = Driver(WORDS, (), None)
STICK_SLIP = Driver((*WORDS, "unresolved"), ("sticks",), ride_with_sticking)
HYBRID = Driver((*WORDS, "unresolved"), ("hops",), ride_with_flights)

#: The word for a run's status if it has not inverted; `not_inverted` for all others.
WORD_OF_STATUS = {GUARD_LOST: WORDS.index("contact_lost"), FAILED: WORDS.index("failed"), UNRESOLVED: len(WORDS)}


def driver_of(scene: Scene) -> Driver:
    """The driver for a scene."""
    if scene.friction.set_valued:
        return STICK_SLIP
    return HYBRID if scene.contact == "hybrid" else SMOOTH


class CellRuns(NamedTuple):
    """What is asked of every cell of a table; see `inversion_table`."""

    driver: Driver
    t1: float
    angle: float
    last: bool
    solver: diffrax.AbstractERK
    method: str
    slopes_by: list[str]

    def results(self, roots: dict[str, Any], columns: dict[str, Any], tolerance: float, count: int) -> dict[str, Any]:
        """The variables of some cells.

        **Arguments:** `roots`: scene and launch; `columns`: full name of a parameter -> its value in every cell, of which the
        first `count` are to be run; `tolerance`: relative tolerance.
        """
        cells = with_numbers(roots, columns)
        scene, launch = cells["scene"], cells["launch"]
        size = next((len(values) for values in columns.values()), 1)
        problem = InversionProblem.of(scene, launch, self.angle, size)
        if self.driver.ride is not None:
            journey = self.driver.ride(scene, problem, self.t1, tolerance, self.last, self.solver, count)
            return self._named(scene, problem, journey) | dict(zip(self.driver.counts, journey.counts, strict=True))
        if not self.slopes_by:
            return self._named(scene, problem, self._outcome(problem, tolerance, count, size))
        options = {"count": count, "size": size, "solver": self.solver, "last": self.last}
        outcome, slopes = slopes_of_cells(roots, columns, self.slopes_by, self.angle, self.t1, tolerance, **options)
        return self._named(scene, problem, outcome) | slopes

    def _outcome(self, problem: InversionProblem, tolerance: float, count: int, size: int) -> Outcome:
        horizon, rtol = jnp.asarray(self.t1), jnp.asarray(tolerance, float)
        if self.method == "diffrax":
            return march_by_diffrax(problem, horizon, rtol, ABSOLUTE * rtol, solver=self.solver)
        options = {"solver": self.solver, "lanes": lanes_for(size), "passes": self.last}
        return compiled_march(problem, horizon, jnp.asarray(count), rtol, ABSOLUTE * rtol, **options)[0]

    def _named(self, scene: Scene, problem: InversionProblem, ended: Outcome | Journey) -> dict[str, Any]:
        inverted = is_inverted(ended, problem, self.last)
        others = [np.asarray(ended.status == status) for status in WORD_OF_STATUS]
        code = np.select([np.asarray(inverted), *others], [0, *WORD_OF_STATUS.values()], 1)
        lost = code == WORDS.index("contact_lost")
        if lost.any():
            # A hybrid run flies on where contact is lost.
            jams = self.driver is HYBRID or np.asarray(_jams(scene.dynamics, jnp.asarray(ended.state)))
            code = np.where(lost & jams, WORDS.index("jammed"), code)
        return {
            "time": np.where(inverted, ended.crossing_time, np.inf),
            "status": code.astype(np.int8),
            "end_time": np.asarray(ended.end_time),
            "end_theta": np.asarray(jax.vmap(scene.theta, 1)(jnp.asarray(ended.state))),
            "steps": np.asarray(ended.steps),
            "rejected": np.asarray(ended.rejected),
        }
