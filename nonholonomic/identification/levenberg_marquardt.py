"""Nonlinear least squares from many starts, or of many data, at once: Optimistix's Levenberg-Marquardt on rows.

A row is one fit. All rows advance together, and the model is evaluated for all of them, with its slopes, in one call; a
model that runs its own cases as lanes of one block therefore runs the cases of all rows in one block.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Bool, Float, Int

from ..progress import Progress
from .likelihood import Measurements
from .unknown import Free

#: Damping of the first step, as a fraction of the largest squared slope (Madsen, Nielsen and Tingleff, "Methods for
#: non-linear least squares problems", 2nd edition (2004), section 3.2).
FIRST_DAMPING = 1e-2

#: A step that gains more than this fraction of what it promised is followed by one with less damping, by the factor `EASED`;
#: one that gains next to nothing is undone, and tried again with more damping, by the factor `HARDENED`.
GOOD, EASED, HARDENED = 0.5, 10.0, 4.0

#: A fit has converged once a step changes no coordinate and no residual by more than this, relatively or absolutely.
CONVERGED = 1e-6

#: It has also converged if a step gains nothing and an undamped one would lower -2 log likelihood by no more than this: it is
#: as close as the errors of the integration allow, within a thirtieth of a standard error of the minimum.
NEGLIGIBLE = 1e-3

#: Singular values of a row's slopes below this fraction of the largest are round-off.
ROUND_OFF = 1e-7


class Problem(eqx.Module):
    """A model and its free parameters.

    - `model`: parameters, name -> (rows,), to predictions (rows, n).
    - `free`: name -> `Free`, as pairs.
    """

    model: Callable[[dict[str, Float[Array, " rows"]]], Float[Array, "rows n"]]
    free: tuple[tuple[str, Free], ...] = eqx.field(static=True)

    def values(self, coordinates: Float[Array, "... unknowns"]) -> Float[Array, "... unknowns"]:
        """The parameters at given coordinates."""
        return jnp.stack([one.value(coordinates[..., k]) for k, (_, one) in enumerate(self.free)], axis=-1)

    def predict(self, coordinates: Float[Array, "rows unknowns"]) -> Float[Array, "rows n"]:
        """What the model predicts in every row."""
        values = self.values(coordinates)
        return self.model({name: values[:, k] for k, (name, _) in enumerate(self.free)})

    def prior(self, coordinates: Float[Array, " unknowns"]) -> Float[Array, " priors"]:
        """Residuals of the priors, in one row."""
        priors = [(k, *one.prior) for k, (_, one) in enumerate(self.free) if one.prior is not None]
        values = self.values(coordinates)
        return jnp.array([(values[k] - mean) / deviation for k, mean, deviation in priors])


class Linearised(NamedTuple):
    """A model and its likelihood at a point of every row.

    - `prediction`: (rows, n); `residual`: (rows, n), those of the data;
    - `jacobian`: (rows, n, unknowns), their slopes along the coordinates;
    - `prior`, `prior_jacobian`: (rows, priors), (rows, priors, unknowns), those of the priors.
    """

    prediction: Float[Array, "rows n"]
    residual: Float[Array, "rows n"]
    jacobian: Float[Array, "rows n unknowns"]
    prior: Float[Array, "rows priors"]
    prior_jacobian: Float[Array, "rows priors unknowns"]

    @property
    def deviance(self) -> Float[Array, " rows"]:
        """-2 log posterior of every row, up to a constant."""
        return jnp.sum(self.residual**2, axis=-1) + jnp.sum(self.prior**2, axis=-1)

    @property
    def whole_jacobian(self) -> Float[Array, "rows residuals unknowns"]:
        """The slopes of data and priors."""
        return jnp.concatenate([self.jacobian, self.prior_jacobian], axis=1)


class Ends(NamedTuple):
    """Where the rows ended: coordinates (rows, unknowns), whether each converged, and in how many steps."""

    coordinates: Float[Array, "rows unknowns"]
    converged: Bool[Array, " rows"]
    steps: Int[Array, " rows"]


@eqx.filter_jit
def predictions_and_slopes(
    problem: Problem, coordinates: Float[Array, "rows unknowns"]
) -> tuple[Float[Array, "rows n"], Float[Array, "rows n unknowns"]]:
    """Predictions and their slopes; rows do not influence one another, so a coordinate is moved in all of them at once.

    Every evaluation of a model is made here, so that it is compiled once for every number of rows.
    """

    def along(direction):
        return jax.jvp(problem.predict, (coordinates,), (jnp.broadcast_to(direction, coordinates.shape),))

    values, slopes = jax.vmap(along, out_axes=(0, -1))(jnp.eye(coordinates.shape[-1]))
    return values[0], jnp.where(jnp.isfinite(slopes), slopes, 0.0)


def linearise(problem: Problem, coordinates: Float[Array, "rows unknowns"], measurements: Measurements) -> Linearised:
    """Predictions, residuals and their slopes.

    **Arguments:**

    - `problem`: the `Problem`.
    - `coordinates`: (rows, unknowns).
    - `measurements`: `Measurements` of shape (n,) or (rows, n).

    **Returns:** a `Linearised`.
    """
    return _linearised(problem, coordinates, measurements, *predictions_and_slopes(problem, coordinates))


@eqx.filter_jit
def _linearised(
    problem: Problem, coordinates: Array, measurements: Measurements, prediction: Array, slopes: Array
) -> Linearised:
    residual, by_prediction = jax.jvp(measurements.residuals, (prediction,), (jnp.ones_like(prediction),))
    prior = jax.vmap(problem.prior)(coordinates)
    prior_jacobian = jax.vmap(jax.jacfwd(problem.prior))(coordinates)
    return Linearised(prediction, residual, by_prediction[..., None] * slopes, prior, prior_jacobian)


class _Row(NamedTuple):
    """What a row minimises: its data, the part of the coordinates that is held, and the unit of its residuals."""

    measurements: Measurements
    held: Float[Array, " unknowns"]
    unit: Float[Array, ""]


class _Tangent(NamedTuple):
    """The model at a point of a row: the point's coordinates, the prediction there, and its slopes."""

    coordinates: Float[Array, " unknowns"]
    prediction: Float[Array, " n"]
    slopes: Float[Array, "n unknowns"]


def _residuals(moving: Float[Array, " moving"], given: tuple[Problem, Array, _Row, _Tangent]) -> Any:
    """All residuals of one row in the form Optimistix expects, with the model linearised.

    A step of Levenberg-Marquardt asks for residuals and slopes at one point only, where the approximation is exact.
    """
    problem, embedding, row, tangent = given
    coordinates = row.held + embedding @ moving
    prediction = tangent.prediction + tangent.slopes @ (coordinates - tangent.coordinates)
    data = row.measurements.residuals(prediction)
    return jnp.concatenate([data, problem.prior(coordinates)]) / row.unit, None


def minimise(
    problem: Problem,
    starts: Float[Array, "rows unknowns"],
    measurements: Measurements,
    *,
    held: int | None = None,
    max_steps: int = 60,
    progress: bool = False,
) -> Ends:
    """Fit every row.

    **Arguments:**

    - `problem`: the `Problem`.
    - `starts`: coordinates, (rows, unknowns).
    - `measurements`: (n,), the same for all rows, or (rows, n).
    - `held`: index of an unknown that keeps its start, or `None`.
    - `max_steps`: a row that needs more has not converged.
    - `progress`: whether to show, on a terminal or in a notebook, how many rows are done.

    **Returns:** the `Ends`.
    """
    starts = jnp.asarray(starts, float)
    rows, unknowns = starts.shape
    measurements = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (rows, leaf.shape[-1])), measurements)
    embedding = jnp.eye(unknowns) if held is None else jnp.delete(jnp.eye(unknowns), held, axis=1)
    done, steps = np.zeros(rows, bool), np.zeros(rows, int)
    with Progress(rows, "fit", shown=progress) as shown:
        begin = linearise(problem, starts, measurements)
        largest = jnp.max(jnp.sum(begin.whole_jacobian**2, axis=1), axis=-1)
        unit = jnp.sqrt(FIRST_DAMPING * jnp.where(largest > 0.0, largest, 1.0 / FIRST_DAMPING))
        moving = starts @ embedding
        row = _Row(measurements, starts - moving @ embedding.T, unit)
        solver = _solver()
        moving, state = _begin(solver, problem, embedding, row, moving)
        for step in range(max_steps):
            coordinates = row.held + state.y_eval @ embedding.T
            tangents = _Tangent(coordinates, *predictions_and_slopes(problem, coordinates))
            moving, state, ended = _step(solver, problem, embedding, row, tangents, moving, state, jnp.asarray(done))
            ended = np.asarray(ended)
            steps[~done] = step + 1
            if step == 0:
                shown.begin()
            shown.advance(int(np.sum(ended & ~done)), steps=step + 1)
            done |= ended
            if done.all():
                break
    return Ends(row.held + moving @ embedding.T, jnp.asarray(done), jnp.asarray(steps))


def _solver() -> Any:
    """Levenberg-Marquardt, with a damping that is reduced sooner than Optimistix's own."""
    search = optimistix.ClassicalTrustRegion(high_cutoff=GOOD, high_constant=EASED, low_constant=1.0 / HARDENED)
    solver = optimistix.LevenbergMarquardt(rtol=CONVERGED, atol=CONVERGED)
    return eqx.tree_at(lambda solver: solver.search, solver, search)


@eqx.filter_jit
def _begin(solver: Any, problem: Problem, embedding: Array, row: _Row, moving: Array) -> tuple[Array, Any]:
    """The solver's state before the first step, in every row."""

    def begin(moving, row):
        unknowns, n = embedding.shape[0], row.measurements.value.shape[0]
        tangent = _Tangent(jnp.zeros(unknowns), jnp.zeros(n), jnp.zeros((n, unknowns)))
        given = (problem, embedding, row, tangent)
        shape = eqx.filter_eval_shape(_residuals, moving, given)[0]
        return solver.init(_residuals, moving, given, {"jac": "fwd"}, shape, None, frozenset())

    return moving, eqx.filter_vmap(begin)(moving, row)


@eqx.filter_jit
def _step(
    solver: Any,
    problem: Problem,
    embedding: Array,
    row: _Row,
    tangents: _Tangent,
    moving: Array,
    state: Any,
    done: Array,
) -> tuple[Array, Any, Array]:
    """One step of every row that is not done; the new points and states, and which rows are done now."""

    def step(moving, state, row, tangent):
        given = (problem, embedding, row, tangent)
        options = {"jac": "fwd"}
        moving, state, _ = solver.step(_residuals, moving, given, options, state, frozenset())
        ended, _ = solver.terminate(_residuals, moving, given, options, state, frozenset())
        stays = state.num_steps_since_acceptance > 0
        return moving, state, ended | (stays & (_promise(state.f_info, row.unit) < NEGLIGIBLE))

    new_moving, new_state, ended = eqx.filter_vmap(step)(moving, state, row, tangents)

    def keep(new, old):
        return jnp.where(done.reshape(-1, *(1,) * (new.ndim - 1)), old, new) if eqx.is_array(new) else new

    return keep(new_moving, moving), jax.tree.map(keep, new_state, state), done | ended


def _promise(info: Any, unit: Float[Array, ""]) -> Float[Array, ""]:
    """By how much an undamped step from the last good point would lower -2 log likelihood, to first order in the model."""
    sides, values, _ = jnp.linalg.svd(info.jac.as_matrix(), full_matrices=False)
    seen = values > ROUND_OFF * jnp.max(values)
    return jnp.sum(jnp.where(seen, sides.T @ info.residual, 0.0) ** 2) * unit**2
