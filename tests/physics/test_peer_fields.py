"""The fields written out for the peers in `benchmarks/fields.py` are those of the scenes."""

import fields
import pytest
from scenes import misprint, scenes

SCENES = scenes(5)


@pytest.mark.parametrize("name", SCENES)
def test_the_peers_integrate_the_same_field(name):
    assert misprint(SCENES[name]) < 1e-14


@pytest.mark.parametrize("number", fields.Ride._fields)
def test_a_number_that_is_off_is_seen(number):
    """The check of the stroller's field looks at every number of the scene."""
    case = SCENES["spheroid, stroller"]
    numbers = case.task.numbers
    changed_numbers = numbers._replace(**{number: getattr(numbers, number) * (1.0 + 1e-9)})
    assert misprint(case._replace(task=case.task._replace(numbers=changed_numbers))) > 1e-12
