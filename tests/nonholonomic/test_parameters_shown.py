"""Numbers, units and modules as a person reads them."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stroller
import tippe
from nonholonomic.text import as_html, as_text, distinguishing_labels, in_unit, readable_unit, text_as_html


@pytest.mark.parametrize(
    ("unit", "shown"),
    [
        ("1", ""),
        ("s", "s"),
        ("kg m2", "kg m²"),
        ("rad s-1", "rad/s"),
        ("m s-2", "m/s²"),
        ("kg m3 s-1", "kg m³/s"),
        ("s m-1", "s/m"),
        ("s-1", "1/s"),
        ("J kg-1 K-1", "J/(kg K)"),
    ],
)
def test_units_are_written_as_people_write_them(unit, shown):
    assert readable_unit(unit) == shown


def test_values_are_told():
    assert as_text(0.02, "kg") == "0.02 kg"
    assert as_text(jnp.asarray(1 / 3), "m s-1") == "0.333333 m/s"
    assert as_text(np.array([1.0, 2.0])) == "[1, 2]"
    assert as_text(np.arange(6.0), "s") == "[0, 1, ..., 5, 6 numbers] s"
    assert as_text((0.0, 1.0), "m") == "(0, 1) m"
    assert as_text(readable_unit) == "readable_unit"
    assert as_text("stop") == "'stop'"


def test_traced_numbers_say_that_they_are():
    shown_values = []
    jax.jit(lambda mu: shown_values.append(repr(tippe.Viscous(mu))) or mu)(0.3)
    assert shown_values == ["Viscous(mu=traced float64[])"]


def test_a_gradient_has_no_units_of_parameters():
    body = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scene = tippe.Scene(body, friction=tippe.Viscous(0.3))
    gradient = jax.grad(lambda scene: scene.body.mass * scene.gravity / scene.friction.mu**2)(scene)
    assert repr(gradient.friction) == "Viscous(mu=-14.5333)"
    # The gradient with respect to gravity is positive, but that with respect to mu, in the same scene, is not.
    assert "gravity   0.222222\n" in str(gradient)
    assert "Top(mass=109, radius=0, offset=0, I1=0, I3=0)" in str(gradient)
    assert "gravity=0.222222," in repr(gradient)
    assert "<td" in gradient._repr_html_()
    assert "kg" not in gradient._repr_html_()
    assert "gravity   9.81 m/s²" in str(scene)


def test_html_escapes_and_lines_are_aligned():
    assert "<td" in as_html("a < b", [("x", "<1>")])
    assert "a &lt; b" in as_html("a < b", [("x", "<1>")])
    assert "&lt;1&gt;" in as_html("a", [("x", "<1>")])
    assert text_as_html("title\nx < 1").count("<pre>x &lt; 1</pre>") == 1
    assert "\n  gravity   9.81 m/s²\n  contact   'hybrid'" in str(tippe.presets.classroom_scene())


def test_runs_are_told_apart_by_what_differs():
    body = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    scenes = [
        tippe.Scene(body, tippe.Plane(), tippe.Viscous(0.3)),
        tippe.Scene(body, tippe.Plane(), tippe.Viscous(0.2)),
    ]
    assert distinguishing_labels([("a", "b")] * 2, scenes) == ["mu 0.3 s/m", "mu 0.2 s/m"]
    assert distinguishing_labels([("a", "b"), ("a", "c")], scenes) == ["b, mu 0.3 s/m", "c, mu 0.2 s/m"]
    scenes[1] = tippe.Scene(body, tippe.Cylinder(0.3), tippe.Viscous(0.3))
    assert distinguishing_labels([("a",), ("b",)], scenes) == ["a, Plane", "b, Cylinder"]
    assert distinguishing_labels([("a",), ("b",), ("a",)], [scenes[0]] * 3) == ["a (1)", "b", "a (2)"]
    assert distinguishing_labels([("a", "b")], scenes[:1]) == ["a, b"]


def test_labels_of_runs_leave_room_for_the_picture():
    launch = tippe.Launch(0.1, 200.0)
    tops = [tippe.presets.wooden(), tippe.presets.cohen(), tippe.presets.rutstam()]
    scenes = [tippe.Scene(top, friction=tippe.Viscous(0.3), contact="hybrid") for top in tops]
    runs = [tippe.simulate(scene, launch, t1=0.01) for scene in scenes]
    figure = runs[0].plot("theta", others=runs[1:])
    figure.draw_without_rendering()
    (panel,) = figure.axes
    legend = panel.get_legend()
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == ["wooden top", "cohen top", "rutstam top"]
    own = tippe.simulate(tippe.Scene(tippe.Top(0.02, 0.02, 0.005, 3e-6, 3.2e-6), contact="hybrid"), launch, t1=0.01)
    assert runs[1].labels_of([runs[1], own], None) == ["cohen top, Viscous", "own top, Frictionless"]
    heavy = dataclasses.replace(own, scene=eqx.tree_at(lambda scene: scene.body.mass, own.scene, jnp.asarray(0.03)))
    names = ["cohen top, mass 0.015 kg, …", "own top, mass 0.02 kg, …", "own top, mass 0.03 kg, …"]
    assert runs[1].labels_of([runs[1], own, heavy], None) == names
    assert max(map(len, texts)) <= 30
    assert panel.get_position().width > 0.8
    assert legend.get_window_extent().y0 >= panel.get_window_extent().y1
    long = distinguishing_labels([("a" * 20, "b" * 20, "c"), ("d" * 20, "b" * 20, "e"), ("a" * 20, "b" * 20, "f")])
    assert long == ["aaaaaaaaaaaaaaaaaaaa, c", "dddddddddddddddddddd, e", "aaaaaaaaaaaaaaaaaaaa, f"]
    cut = distinguishing_labels([("a" * 20, "b" * 20), ("a" * 20, "c" * 20), ("d", "b" * 20)])
    assert cut == ["aaaaaaaaaaaaaaaaaaaa, bbbbbbb…", "aaaaaaaaaaaaaaaaaaaa, ccccccc…", "d, bbbbbbbbbbbbbbbbbbbb"]
    assert distinguishing_labels([("a" * 40,), ("b",)]) == [f"{'a' * 29}…", "b"]
    # What tells runs apart comes before what does not, and then as much as there is room for.
    starts = [("one", "x" * 15, "p"), ("one", "y" * 15, "p"), ("two", "y" * 15, "q"), ("two", "y" * 15, "p")]
    assert distinguishing_labels(starts) == [f"{a}, {b}, {c}" for a, b, c in starts]
    starts = [(*start, f"{k} and much more") for k, start in enumerate(starts)]
    assert distinguishing_labels(starts) == [f"{a}, {b}, {c}, …" for a, b, c, _ in starts]
    of_two_tops = [("wooden top", "6 deg"), ("own top", "6 deg"), ("own top", "6 deg")]
    assert distinguishing_labels(of_two_tops, [tippe.Viscous(mu) for mu in (0.3, 0.3, 0.1)]) == [
        "wooden top, mu 0.3 s/m",
        "own top, mu 0.3 s/m",
        "own top, mu 0.1 s/m",
    ]


def test_numbers_are_shown_in_other_units():
    assert in_unit("rad", "deg") == ("deg", pytest.approx(180.0 / np.pi))
    assert in_unit("rad s-1", "deg") == ("deg/s", pytest.approx(180.0 / np.pi))
    body = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    tilted = [tippe.Scene(body, tippe.Plane(tilt), tippe.Viscous(0.3)) for tilt in (None, 0.1, 0.2)]
    assert distinguishing_labels([()] * 3, tilted, unit="degrees") == ["no tilt", "tilt 5.73 deg", "tilt 11.46 deg"]
    for name in ("degrees", "°", "degree"):
        assert in_unit("rad", name) == in_unit("rad", "deg")
    assert in_unit("rad s-1", "turns/s") == ("rev/s", pytest.approx(0.5 / np.pi))
    assert in_unit("rad s-1", ["deg", "rpm"]) == ("rpm", pytest.approx(30.0 / np.pi))
    assert in_unit("1/s", "ms") == ("1/s", 1.0)
    assert in_unit("1", "deg") == ("1", 1.0)
    assert readable_unit("deg/s") == "deg/s"


def test_no_public_object_shows_the_shapes_of_its_arrays():
    launch = tippe.Launch(0.1, 155.0)
    times = tippe.InversionTimes(tippe.Launch([0.1, 0.2], 100.0), [1.0, 2.0], 0.1, t1=5.0)
    body = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    shown = [
        repr(times),
        repr(tippe.Recording(launch, [0.0, 0.5], [0.1, 0.2], 0.01)),
        repr(stroller.Recording(stroller.Launch((0.0, 0.0), 0.0, 1.0), [1.0], np.ones((1, 3)), 0.1)),
        repr(tippe.log_density(tippe.Scene(body), times, {"offset": 0.006})),
        repr(stroller.ImplicitMidpoint(0.01)),
    ]
    assert "time=[1, 2] s" in shown[0]
    assert "times=[0, 0.5] s" in shown[1]
    assert shown[3:] == [
        "LogDensity of scene.body.offset, given 2 measurements",
        "ImplicitMidpoint(step_length=0.01 s)",
    ]
    assert not any("f64[" in text for text in shown)
