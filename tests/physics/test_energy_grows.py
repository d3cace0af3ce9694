"""Without a drive the energy of a top never grows: a run that ends with more than it began with is unresolved."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tops import rutstam_top

import tippe
from tippe.friction import ContactLoad

UNRESOLVED = int(tippe.Status.UNRESOLVED)
LAUNCH = tippe.Launch(0.1, 155.0)
WHY = "although nothing drives the top"


class Pushes(tippe.Viscous):
    """A law of friction whose sign is wrong."""

    def per_normal_force(self, slip):
        f1, f2 = super().per_normal_force(slip).force
        return ContactLoad(force=(-f1, -f2))


class Mistaken(tippe.Paraboloid):
    """A bowl that states ten times its heights, so that a top that climbs its wall gains energy."""

    def elevation(self, position):
        return 10.0 * position[2]


def pushed(**options):
    return tippe.Scene(rutstam_top(), friction=Pushes(0.1), **options)


def test_a_table_and_a_time_say_that_the_energy_has_grown():
    """The slip grows by exp(3.4) within a second, and the energy with it."""
    with pytest.warns(UserWarning, match=f"1 of 1 runs are unresolved: .*{WHY}"):
        table = tippe.inversion_table(pushed(), theta=0.1, spin=155.0, t1=1.0, tolerance=1e-6)
    assert str(table.status) == "unresolved"
    assert np.isinf(table.time)
    with pytest.warns(UserWarning, match=f"the run ended as 'unresolved'.*{WHY}"):
        assert np.isnan(tippe.inversion_time(pushed(), LAUNCH, 1.0, tolerance=1e-6))


@pytest.mark.slow
@pytest.mark.parametrize(
    "scene",
    [
        pushed(),
        pushed(contact="hybrid"),
        pushed(surface=tippe.Sphere(0.5), contact="hybrid"),
        pushed(surface=tippe.Cylinder(0.3)),
    ],
    ids=["plane", "plane with flights", "sphere with flights", "cylinder"],
)
def test_every_road_says_that_the_energy_has_grown(scene):
    times = np.array([0.5, 1.0])
    run = tippe.simulate(scene, LAUNCH, 1.0, tolerance=1e-7)
    assert run.energy[-1] > 1.01 * run.energy[0]
    assert run.status == "unresolved"
    assert f"unresolved: the energy has grown by {run.energy[-1] - run.energy[0]:.1e} J" in str(run)

    @jax.jit
    @jax.vmap
    def batch(theta):
        run = tippe.simulate(scene, tippe.Launch(theta, 155.0), 1.0, times, 1e-7)
        return run.status, tippe.inversion_time(scene, tippe.Launch(theta, 155.0), 1.0, tolerance=1e-7)

    status, time = batch(jnp.array([0.1, 0.2]))
    assert status.tolist() == [UNRESOLVED, UNRESOLVED]
    assert np.isnan(time).all()
    smooth = scene.contact == "stop"
    with pytest.warns(UserWarning, match=WHY) if smooth else pytest.MonkeyPatch.context():
        table = tippe.inversion_table(scene, theta=[0.1, 0.2], spin=155.0, t1=1.0, errors=True)
    assert table.status.tolist() == ["unresolved", "unresolved"]
    assert (table.status_error == 1).all()
    if smooth:
        table = tippe.trajectory_table(scene, theta=[0.1, 0.2], spin=155.0, times=times)
        assert table.status.tolist() == ["unresolved", "unresolved"]


@pytest.mark.slow
@pytest.mark.parametrize("contact", ["stop", "hybrid"])
def test_an_arena_that_misstates_its_heights_is_unresolved_in_tables_too(contact):
    scene = tippe.Scene(rutstam_top(), Mistaken(0.3), tippe.Viscous(0.3), contact=contact)
    launch = {"launch.place[0]": 0.0, "launch.place[1]": 0.0, "launch.velocity[0]": 1.0, "launch.velocity[1]": 0.0}
    arguments = {"theta": 0.1, "spin": 100.0, "t1": 0.1, "axes": launch}
    with pytest.warns(UserWarning, match=WHY) if contact == "stop" else pytest.MonkeyPatch.context():
        table = tippe.inversion_table(scene, **arguments)
    assert str(table.status) == "unresolved"
