"""The axes of a table, named by the ends of the full names of numbers."""

import dataclasses
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from never_run import PRAM, RIDE, TOP
from tops import rutstam_top

import nonholonomic.sweeps
import stroller
import tippe
from nonholonomic.parameters import full_name, numbers, with_numbers
from tippe.runs.model import TopModel
from tippe.runs.verbs import launches

pytestmark = pytest.mark.oldest


class Hill(eqx.Module):
    """A ground whose numbers are an array."""

    bends: jax.Array

    def __call__(self, x, y):
        return self.bends[0] * x * x + self.bends[1] * y * y


def stem_top():
    return dataclasses.replace(rutstam_top(), stem=tippe.Stem(0.005, 0.022))


def axes_of(scene, axes):
    _, grid = launches(scene, {"theta": 0.1, "spin": 155.0, "mu": None}, axes, 1.0, 1e-9)
    return {axis.name: axis.number for axis in grid}


def test_an_axis_may_be_named_by_its_end():
    stemmed = tippe.Scene(stem_top(), tippe.Cylinder(0.3), tippe.Coulomb(0.3, 0.01), contact="hybrid")
    assert axes_of(stemmed, {"mu": [0.1, 0.2], "slip_speed": [0.1, 0.2], "restitution": [0.1, 0.2]}) == {
        "mu": "scene.friction.mu",
        "slip_speed": "scene.friction.slip_speed",
        "restitution": "scene.restitution",
    }
    assert axes_of(TOP, {"offset": [0.005, 0.006], "tilt": [0.0, 0.1]}) == {
        "offset": "scene.body.offset",
        "tilt": "scene.surface.tilt",
    }
    assert axes_of(TOP, {"velocity[0]": [0.0, 0.1]}) == {"velocity_t1": "launch.velocity[0]"}
    assert list(axes_of(stemmed, {"stem.offset": [0.022, 0.023]}).values()) == ["scene.body.stem.offset"]


def test_a_coordinate_of_the_place_does_not_lend_its_unit_to_the_friction():
    scene = tippe.Scene(rutstam_top(), tippe.Spheroid(0.3, 0.2), tippe.Viscous(0.3))
    labels = TopModel(scene=scene, launch=tippe.Launch(0.1, 155.0, place=(-1.2, 0.1))).label
    assert labels(["scene.friction.mu"])["scene.friction.mu"][:2] == ("mu", "s m-1")
    assert labels(["launch.place[0]"])["launch.place[0]"][:2] == ("mu", "rad")


def test_the_stem_follows_the_centre_of_mass_unless_its_offset_grows_too():
    # As the documentation of `Top.offset` says.
    top, grown = stem_top(), {"body.offset": 0.0065, "stem.offset": 0.0225}
    assert (top.offset, top.stem.offset) == (0.006, 0.022)
    for values, distance in (({"body.offset": 0.0065}, 0.0155), (grown, 0.016)):
        body = with_numbers({"scene": tippe.Scene(top, contact="hybrid")}, values)["scene"].body
        assert float(body.stem.offset - body.offset) == pytest.approx(distance, abs=1e-15)


def test_a_number_is_replaced_by_the_end_of_its_name():
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
    assert with_numbers({"scene": scene}, {"mu": 0.9})["scene"].friction.mu == 0.9


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"ofset": [0.005]}, "axes: 'ofset' must be one of .*; did you mean 'offset'"),
        ({"offset": [0.02, 0.021]}, "axes: 'offset' could be scene.body.offset or scene.body.stem.offset"),
        ({"body.mass": [0.02], "mass": [0.02]}, "axes = body.mass, mass: a number is named twice"),
        ({"theta": [0.1]}, "axes: 'launch.theta' has its own argument"),
    ],
)
def test_an_axis_whose_name_means_nothing_or_too_much_is_refused(axes, message):
    with pytest.raises(ValueError, match=message):
        axes_of(tippe.Scene(stem_top(), friction=tippe.Viscous(0.3), contact="hybrid"), axes)


def test_only_what_can_be_varied_is_suggested():
    with pytest.raises(ValueError, match="axes: 'colour'") as refused:
        axes_of(TOP, {"colour": [1.0]})
    suggestions = re.findall(r"[\w.\[\]]+", str(refused.value).partition("must be one of ")[2])
    assert "scene.surface.tilt" in suggestions
    for name in suggestions:
        if name not in ("launch.theta", "launch.spin", "launch.eta", "launch.place[2]"):
            assert axes_of(TOP, {name: [1e-3]}) if "body" not in name else name in numbers("scene", TOP)
    with pytest.raises(ValueError, match="axes: 'colour'") as refused:
        stroller.sweep(PRAM, RIDE, 1.0, axes={"colour": [1.0]})
    names = re.findall(r"[\w.\[\]]+", str(refused.value).partition("must be one of ")[2])
    assert {"scene.body.centre", "launch.place[1]", "launch.speed"} <= set(names)
    assert not {"scene.side", "scene.fork"} & set(names)


def test_the_axes_of_rides_may_be_named_by_their_ends_too(monkeypatch):
    def only_axes(job, grid, *_, **__):
        raise KeyError(*(axis.number for axis in grid))

    monkeypatch.setattr(nonholonomic.sweeps, "sweep", only_axes)
    with pytest.raises(KeyError) as axes:
        stroller.sweep(PRAM, RIDE, 1.0, axes={"speed": [1.0, 2.0], "place[1]": [0.0, 1.0], "wheelbase": [0.6]})
    assert axes.value.args == ("launch.speed", "launch.place[1]", "scene.body.wheelbase")
    sprung = dataclasses.replace(PRAM, friction=stroller.Damping(1.0))
    with pytest.raises(ValueError, match=r"axes: 'steering' could be scene\.friction\.steering or launch\.steering"):
        stroller.sweep(sprung, RIDE, 1.0, axes={"steering": [0.1]})


def test_what_the_function_of_a_ground_holds_may_be_lists_in_tables_too():
    scene = tippe.Scene(rutstam_top(), tippe.Graph(Hill(jnp.array([0.05, 0.1]))), tippe.Viscous(0.3))
    _, grid = launches(scene, {"theta": 0.1, "spin": [100.0, 120.0]}, None, 1.0, 1e-9)
    assert [axis.name for axis in grid] == ["spin"]
    with pytest.raises(ValueError, match=r"scene\.gravity must be one number, not of shape"):
        launches(eqx.tree_at(lambda s: s.gravity, scene, jnp.ones(2)), {"theta": 0.1, "spin": 1.0}, None, 1.0, 1e-9)


class Knots(eqx.Module):
    """A drive force with knots."""

    knots: jax.Array
    gain: float = 1.0

    def __call__(self, t, motion):
        return self.gain * jnp.interp(t, jnp.linspace(0.0, 1.0, self.knots.size), self.knots), 0.0


def test_the_numbers_of_a_large_input_have_no_names_and_the_message_says_what_to_do():
    options = {"axes": {"knots[3]": [1.0]}, "input": Knots(jnp.ones(300))}
    with pytest.raises(
        ValueError, match=r"axes: 'knots\[3\]': input = Knots .* more than 256 numbers, .* reads large arrays"
    ):
        stroller.sweep(PRAM, RIDE, 1.0, **options)
    with pytest.raises(ValueError, match=r"axes: 'input.gain': input = Knots .* more than 256 numbers"):
        nonholonomic.sweep(PRAM, RIDE, 1.0, **options | {"axes": {"input.gain": [1.0]}})
    with pytest.raises(ValueError, match=r"'input.force': input = .* is a function, .* write an equinox\.Module"):
        stroller.sweep(PRAM, RIDE, 1.0, axes={"input.force": [1.0]}, input=lambda t, motion: (1.0, 0.0))
    # A name that has nothing to do with the input.
    with pytest.raises(ValueError, match=r"'colour' must be one of scene\.body\.mass"):
        stroller.sweep(PRAM, RIDE, 1.0, **options | {"axes": {"colour": [1.0]}})


def test_a_message_names_the_first_and_the_last_number_of_an_array():
    known = ["scene.gravity", *(f"input.knots[{k}]" for k in range(200))]
    with pytest.raises(ValueError, match=r"gravity, input.knots\[0\], \.\.\., input.knots\[199\]; did you mean 'knots"):
        full_name("axes", "knots", known)
