"""What programs cost on any machine: operations and steps are no more than `benchmarks/cost.json` records."""

import functools

import cost
import jax
import jax.numpy as jnp
import pytest
from operations import operations, operations_per_step
from scenes import scenes

FIELDS, RECORD = dict(cost.fields()), cost.record()
#: JAX's rules of differentiation differ from version to version; the record is of 0.10.
NAMES = [name for name in FIELDS if "derivatives" not in name or jax.__version_info__[:2] == (0, 10)]

all_scenes = functools.cache(lambda: scenes(cost.LAUNCHES))

#: Scenes whose programs the tests of tables compile too.
COMPILED_ANYWAY = ("plane, viscous", "cylinder, viscous")


def test_the_record_has_every_field_and_scene():
    assert set(RECORD) == {"field", "step", "steps"}
    assert set(RECORD["field"]) == set(RECORD["step"]) == set(FIELDS)
    assert set(RECORD["steps"]) == set(all_scenes())


@pytest.mark.parametrize("name", NAMES)
def test_fields_have_no_more_operations_than_recorded(name):
    counts = cost.counts_of_field(FIELDS[name])
    assert not cost.has_grown(RECORD["field"][name], counts), counts


@pytest.mark.parametrize("name", ["top, plane"])
def test_a_step_has_no_more_operations_than_recorded(name):
    counts = cost.counts_of_step(FIELDS[name])
    assert not cost.has_grown(RECORD["step"][name], counts), counts


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_steps_of_all_fields_have_no_more_operations_than_recorded(name):
    test_a_step_has_no_more_operations_than_recorded(name)


@pytest.mark.parametrize("name", COMPILED_ANYWAY)
def test_launches_take_no_more_steps_than_recorded(name):
    counts = cost.steps(all_scenes()[name])
    assert not cost.has_grown(RECORD["steps"][name], counts), counts


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(set(RECORD["steps"]) - set(COMPILED_ANYWAY)))
def test_launches_of_other_scenes_take_no_more_steps_than_recorded(name):
    test_launches_take_no_more_steps_than_recorded(name)


def test_growth_by_three_per_cent_is_seen():
    assert not cost.has_grown([100.0, 50.0], [101.9, 50.0])
    assert cost.has_grown([100.0, 50.0], [100.0, 51.5])
    assert cost.has_grown([100.0], [100.0, 1.0])


def test_operations_in_loops_and_branches_are_counted():
    """Horner's rule in a loop of 7 passes has 2 operations on 5 numbers in each; the shorter of two branches counts."""

    def horner(x):
        jnp.exp(x)  # Nothing depends on it.
        return jax.lax.fori_loop(0, 7, lambda _, total: total * x + 1.0, jnp.zeros(5))

    def one_of_two(x):
        return jax.lax.cond(x[0] > 0.0, lambda x: jnp.sin(x) + x, lambda x: x + 1.0, x)

    assert operations(horner, jnp.ones(5)) == (7 * 2 * 5, 0)
    assert operations(jax.jit(jnp.sin), jnp.ones(5)) == (0, 5)
    assert operations(one_of_two, jnp.ones(5)) == (5, 0)


def test_one_more_operation_in_a_field_shows_thirteen_times_in_a_step():
    """The pair has thirteen stages, so a factor on eight components is 104 operations, 4 % of a step."""
    (problem,) = FIELDS["top, plane"]()
    kind = type(problem)
    slow_kind = type("Slower", (kind,), {"field": lambda self, time, state: 1.5 * kind.field(self, time, state)})
    slow_problem = slow_kind(problem.dynamics, problem.cos_angle, problem.states, problem.scales)
    operations = operations_per_step(slow_problem).arithmetic
    assert operations - operations_per_step(problem).arithmetic == pytest.approx(13 * 8)
    assert cost.has_grown(RECORD["step"]["top, plane"], [operations])
