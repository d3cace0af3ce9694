"""Runs through flights and impacts, and the stem: an independent event-driven reference, closed forms, conservation."""

import csv
import math
from pathlib import Path

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close
from hop_reference import CASES, Case, row
from stems import first_contact, free_body, jellett
from tops import rutstam_top

import tippe
from tippe import steady
from tippe.modes.impact import balls, standing_on

REFERENCE = list(csv.DictReader(Path(__file__).with_name("hop_reference.csv").read_text().splitlines()))


def leine_glocker_top() -> tippe.Top:
    """The top of Leine and Glocker (2003), with its stem."""
    return tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, stem=tippe.Stem(radius=5e-3, offset=0.016))


def scene_of(case: Case, restitution: float | None = None) -> tippe.Scene:
    """The scene of a reference case."""
    stem = tippe.Stem(case.stem_radius, case.stem_offset) if case.stem_radius else None
    friction = tippe.Coulomb(case.mu, case.slip_speed) if case.slip_speed else tippe.Viscous(case.mu)
    if case.contact_radius:
        disc = tippe.Contensou(case.mu, case.contact_radius, case.slip_speed)
        friction = tippe.Rolling(case.resistance, case.turning_speed, disc)
    top = tippe.Top(case.mass, case.radius, case.offset, case.I1, case.I3, stem)
    coefficient = case.restitution if restitution is None else restitution
    return tippe.Scene(top, tippe.Plane(), friction, case.gravity, contact="hybrid", restitution=coefficient)


def check_against_reference(table: tippe.Table, place: tuple[int, ...], expected: dict[str, str]) -> None:
    """A cell that inverts at the reference's time, after as many flights; the errors seen are below 2e-9."""
    assert table.status[place] == expected["status"]
    assert_close(table.time[place], float(expected["time"]), rtol=1e-8)
    assert table.hops[place] == int(float(expected["flights"]))
    assert_close(table.end_theta[place], float(expected["end_theta"]), atol=1e-8)


SPINS, RESTITUTIONS = [180.0, 200.0, 250.0, 280.0], [0.0, 0.5]


@pytest.fixture(scope="module")
def hopping_table() -> tippe.Table:
    """Rutstam's top at spins at which it hops, with and without restitution."""
    axes = {"scene.restitution": RESTITUTIONS}
    return tippe.inversion_table(scene_of(CASES[0], 0.1), theta=0.1, spin=SPINS, axes=axes, t1=20.0, tolerance=1e-11)


def test_inversion_times_through_hops(hopping_table):
    """The top lands and inverts after all, after 7 to 333 flights; NumPy and SciPy by other equations see the same."""
    for case, expected in zip(CASES[:5], REFERENCE[:5], strict=True):
        place = (SPINS.index(case.spin), RESTITUTIONS.index(case.restitution))
        check_against_reference(hopping_table, place, expected)
    assert (hopping_table.status == "inverted").all()


def test_a_cell_does_not_depend_on_its_neighbours(hopping_table):
    axes = {"scene.restitution": [0.5, 0.0]}
    spins = [280.0, 150.0, 200.0]
    finer_table = tippe.inversion_table(
        scene_of(CASES[0], 0.1), theta=0.1, spin=spins, axes=axes, t1=20.0, tolerance=1e-11
    )
    for spin in (200.0, 280.0):
        # The order of the axes' values is turned round.
        assert_close(finer_table.time[spins.index(spin), ::-1], hopping_table.time[SPINS.index(spin)], rtol=1e-12)
        np.testing.assert_array_equal(finer_table.hops[spins.index(spin), ::-1], hopping_table.hops[SPINS.index(spin)])
    # Where contact is never lost restitution makes no difference.
    assert finer_table.hops[1].tolist() == [0, 0]
    assert finer_table.time[1, 0] == finer_table.time[1, 1]


@pytest.mark.slow
@pytest.mark.parametrize("number", range(5, 9))
def test_coulomb_hops_and_the_stem(number):
    case = CASES[number]
    arguments = {"t1": case.t1, "angle": case.angle, "tolerance": 1e-11}
    table = tippe.inversion_table(scene_of(case), theta=case.theta, spin=[case.spin], **arguments)
    check_against_reference(table, (0,), REFERENCE[number])


@pytest.mark.slow
def test_the_reference_is_what_its_program_writes():
    for number in (5, 7):
        entry = row(CASES[number])
        assert_close(entry["time"], float(REFERENCE[number]["time"]), rtol=1e-9)
        assert entry["flights"] == float(REFERENCE[number]["flights"])


@pytest.mark.slow
def test_time_converges_through_events():
    """The error falls with the tolerance through 23 flights and impacts, in proportion."""
    scene, exact = scene_of(CASES[1]), float(REFERENCE[1]["time"])
    times = [
        tippe.inversion_table(scene, theta=0.1, spin=[200.0], t1=20.0, tolerance=tol).time[0] for tol in (1e-9, 1e-11)
    ]
    errors = np.abs(np.array(times) - exact)
    assert 30.0 < errors[0] / errors[1] < 300.0


@pytest.mark.slow
def test_last_crossing_through_flights():
    """The last crossing is the one after which theta stays above, whether it is passed on the plane or in the air."""
    scene = scene_of(CASES[1])
    angle = 1.9
    arguments = {"theta": 0.1, "spin": [200.0], "t1": 6.3, "tolerance": 1e-10, "angle": angle}
    last = tippe.inversion_table(scene, crossing="last", **arguments)
    first = tippe.inversion_table(scene, **arguments)
    run = tippe.simulate(scene, tippe.Launch(0.1, 200.0), 6.3, times=np.linspace(0.0, 6.3, 200_001), tolerance=1e-10)
    is_above = run.theta >= angle
    crossings = run.t[1:][is_above[1:] & ~is_above[:-1]]
    assert last.status[0] == first.status[0] == "inverted"
    assert len(crossings) > 1
    assert_close(last.time[0], crossings[-1], atol=4e-5)
    assert_close(first.time[0], crossings[0], atol=4e-5)


# The stem


@pytest.fixture(scope="module")
def ride() -> tippe.HybridTrajectory:
    """Leine and Glocker's top: it hops, goes over to its stem and spins on it."""
    scene = tippe.Scene(leine_glocker_top(), friction=tippe.Coulomb(0.3, 0.05), contact="hybrid")
    return tippe.simulate(scene, tippe.Launch(0.1, 250.0), 4.0, tolerance=1e-10)


def test_a_launch_beyond_the_angle_without_contact_is_inverted_at_the_start():
    """The spin about t1 pulls the top off the plane; it flies, and theta falls below the angle and returns."""
    scene = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid")
    axes = {"launch.angular_velocity[0]": [0.0, 60.0]}
    table = tippe.inversion_table(scene, theta=2.9, spin=0.0, t1=0.5, angle=2.5, tolerance=1e-6, axes=axes)
    assert list(table.status) == ["inverted", "inverted"]
    assert list(table.time) == [0.0, 0.0]
    assert list(table["hops"]) == [0, 0]
    assert_close(table.end_theta, 2.9, atol=1e-12)


def test_the_top_goes_over_to_its_stem(ride):
    assert ride.status == "completed"
    assert set(ride.contact) == {-1, 0, 1}
    assert ride.contact[-1] == 1
    assert len(ride.hops) > 10
    assert ride.theta[-1] > 3.0
    # It stands on its stem, faster than it must.
    assert abs(ride.spin[-1]) > steady.inverted_critical_spin(ride.scene)
    changes = np.flatnonzero((ride.contact[1:] == 1) & (ride.contact[:-1] == 0))
    assert_close(ride.theta[changes], first_contact(ride.scene.body), atol=2e-7)


def test_nothing_enters_the_plane_and_nothing_pulls(ride):
    height, lean = ride.position[:, 2], np.cos(ride.theta)
    assert np.min(height - 0.015) > -1e-10
    assert np.min(height + 0.013 * lean - 0.005) > -1e-10
    assert np.min(ride.normal_force) > -1e-8 * 6e-3 * 9.81
    assert np.all(ride.normal_force[ride.contact == -1] == 0.0)


def test_energy_falls_and_jellett_stays_through_hops(ride):
    """Energy never grows; Jellett's quantity is that of the sphere that touches, in flights and impacts too."""
    assert np.max(np.diff(ride.energy)) < 1e-8 * ride.energy[0]
    assert ride.stats["energy_residual"] < 1e-9 * ride.energy[0]
    assert ride.stats["impact_loss"] > 0.0
    on_stem = np.flatnonzero(ride.contact == 1)
    jellett_before = ride.jellett[: on_stem[0]]
    assert np.sum(ride.contact[: on_stem[0]] == -1) > 10
    assert_close(jellett_before, jellett_before[0], rtol=1e-9)
    # From the last time that the sphere touches, that of the stem.
    last = np.flatnonzero(ride.contact == 0)[-1] + 1
    stem = jellett(balls(ride.scene.body)[1], free_body(ride))[last:]
    assert_close(stem, stem[0], rtol=1e-9)
    assert abs(ride.jellett[-1] / jellett_before[0] - 1.0) > 1e-3


def test_a_ride_at_other_times_is_the_same(ride):
    ends = np.sort(ride.hops.ravel())
    sampled_times, middles = ride.t[::7], ride.hops.mean(axis=1)
    times = np.unique(np.concatenate([sampled_times, middles, ends, ends + 1e-9]))
    samples = ride.at(times)

    def places(kind):
        return np.searchsorted(times, kind)

    for name in ("theta", "energy", "spin_angle"):
        assert_close(getattr(samples, name)[places(sampled_times)], getattr(ride, name)[::7], rtol=1e-12, atol=1e-12)
    assert np.all(samples.contact[places(middles)] == -1)
    # Positions are continuous, also where velocities are not.
    for name, atol in (("position", 1e-8), ("rotation", 1e-6)):
        samples_of_name = getattr(samples, name)
        assert_close(samples_of_name[places(ends + 1e-9)], samples_of_name[places(ends)], atol=atol)
    assert "flights" in str(ride)
    with pytest.raises(ValueError, match=r"must be at most .* \(the run ends there\)"):
        ride.at([4.5])


def test_the_rotation_goes_with_the_angular_velocity(ride):
    """In a flight, on the sphere and on the stem: R' = w x R."""
    step, moments = 1e-6, []
    for number in (-1, 0, 1):
        steps = np.flatnonzero((ride.contact[1:] == number) & (ride.contact[:-1] == number))
        longest_steps = steps[np.argmax(np.diff(ride.t)[steps])]
        moments.append(ride.t[longest_steps : longest_steps + 2].mean())
    run = ride.at(np.add.outer(sorted(moments), [-step, 0.0, step]).ravel())
    rotation = np.asarray(run.rotation).reshape(3, 3, 3, 3)
    rate = (rotation[:, 2] - rotation[:, 0]) / (2.0 * step)
    turning = np.asarray(run.angular_velocity)[1::3]
    expected = np.cross(turning[:, :, None], rotation[:, 1], axis=1)
    assert_close(rate, expected, atol=1e-6 * np.max(np.abs(turning)))
    assert_close(np.swapaxes(rotation, -1, -2) @ rotation, np.broadcast_to(np.eye(3), rotation.shape), atol=1e-14)


def test_closed_forms_of_the_stem():
    """The literature's 2.448 rad, and 88.11 rad/s as the spin at which an eigenvalue changes sign."""
    top = leine_glocker_top()
    assert_close(first_contact(top), 2.44843, atol=5e-6)
    scene = tippe.Scene(top, friction=tippe.Viscous(0.3), contact="hybrid")
    assert_close(steady.inverted_critical_spin(scene), 88.11, atol=5e-3)
    with pytest.raises(ValueError, match="must be None: a top with a stem"):
        steady.jellett_thresholds(scene)
    dynamics = standing_on(scene.dynamics, balls(top)[1])
    jacobian = jax.jit(jax.jacfwd(dynamics.field))

    def growth(spin):
        state = jnp.array([0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, -7e-7 * spin])
        # |e| and the spin are neutral.
        rows_used = np.array([0, 1, 2, 3, 5, 6])
        return np.max(np.linalg.eigvals(np.asarray(jacobian(state))[np.ix_(rows_used, rows_used)]).real)

    assert growth(0.97 * 88.11) > 1e-3
    # Two more are neutral: a circular slide of the tilted, slipless top does not exist above the threshold.
    assert growth(1.03 * 88.11) < 1e-9


# In a cylinder, from its wall


def test_a_start_on_the_wall_has_contact():
    """At eta = pi/2 the normal force starts from 0 as 3/2 m g^2 t^2 / (rho (1 + m a A)) (tippe.md, section 8)."""
    top = rutstam_top()
    scene = tippe.Scene(top, tippe.Cylinder(0.3), tippe.Viscous(0.3))
    launch = tippe.Launch(np.array([0.1, 0.5, 1.2]), 78.125 * np.ones(3), math.pi / 2.0 * np.ones(3), np.zeros(3))
    state, dynamics = scene.state(launch), scene.dynamics
    # The friction is that of the slip at the start; 1 + m a A is the slope of the equation for N.
    weight, rho, a, R = 0.02 * 9.81, 0.28, 0.006, 0.02
    field = eqx.filter_jit(dynamics.field)
    h, steps = 2e-5, 100
    for _ in range(steps):
        k1 = field(state)
        k2 = field(state + h / 2 * k1)
        k3 = field(state + h / 2 * k2)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + field(state + h * k3))
    motion = dynamics.motion(scene.state(launch))
    e = np.asarray(scene.state(launch)[2:5])
    push = sum(force * direction for force, direction in zip(motion.friction.force, e, strict=False))
    A = (a * (1.0 - e[2] ** 2) + (R - a * e[2]) * push) / float(top.I1)
    expected = 1.5 * weight * 9.81 * (h * steps) ** 2 / (rho * (1.0 + 0.02 * a * A))
    assert_close(scene.normal_force(state) / expected, 1.0, atol=6e-3)


@pytest.mark.slow
def test_a_table_starts_on_the_wall():
    scene = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), tippe.Viscous(0.3))
    etas = [math.pi / 2.0 - 1e-9, math.pi / 2.0]
    table = tippe.inversion_table(scene, theta=[0.1, 0.5, 1.2], spin=78.125, eta=etas, t1=2e-3)
    assert (table.status == "not_inverted").all()


# What is refused


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda top: tippe.Scene(top, contact="fly"), "contact = 'fly' must be 'stop' or 'hybrid'"),
        (lambda top: tippe.Scene(top), "a top with a stem needs contact='hybrid', as in Scene"),
        (lambda top: tippe.Scene(rutstam_top(), restitution=0.5), "restitution = 0.5 needs contact='hybrid'"),
        (lambda top: tippe.Scene(top, contact="hybrid", restitution=1.5), "restitution = 1.5 must be at most 1.0"),
        (lambda top: tippe.Stem(0.0, 0.02), "stem radius = 0.0 must be greater than 0.0"),
        (lambda top: tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, tippe.Stem(5e-3, 0.01)), "neither sphere lies within"),
        (lambda top: tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, 0.3), "stem = 0.3 must be a Stem"),
        (
            lambda top: tippe.inversion_table(
                tippe.Scene(top, contact="hybrid"), theta=0.1, spin=100.0, t1=1.0, method="diffrax"
            ),
            "method = 'diffrax' does not support runs of several modes",
        ),
        (
            lambda top: jax.jit(
                lambda spin: tippe.simulate(tippe.Scene(top, contact="hybrid"), tippe.Launch(0.1, spin), 1.0).theta
            )(100.0),
            "times must be given inside jit",
        ),
        (
            # The smallest of such programs: it is traced before the times are looked at.
            lambda _: jax.grad(
                lambda time: tippe.simulate(
                    tippe.Scene(rutstam_top(), contact="hybrid"), tippe.Launch(0.1, 100.0), 1.0, times=jnp.stack([time])
                ).theta[0]
            )(0.5),
            "derivatives with respect to times or t1 are not available",
        ),
        (
            lambda top: jax.jit(
                lambda spin: (
                    tippe.simulate(
                        tippe.Scene(top, contact="hybrid"),
                        tippe.Launch(0.1, spin),
                        1.0,
                        times=[1.0],
                        adjoint=diffrax.ForwardMode(),
                    ).theta
                )
            )(100.0),
            "adjoint = .* must be omitted for contact = 'hybrid'",
        ),
    ],
)
def test_what_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make(leine_glocker_top())


def test_the_wooden_top_of_the_classroom_climbs_onto_its_stem():
    """It stands on its stem in the end, faster than it must; the shape and the friction are those of `tippe.presets`."""
    scene = tippe.presets.classroom()
    run = tippe.simulate(scene, tippe.Launch.degrees(theta=6, rpm=1900), 4.0, tolerance=1e-10)
    assert run.theta[-1] > 3.0
    assert run.contact[-1] == 1
    assert abs(run.spin[-1]) > steady.inverted_critical_spin(scene)
    assert run.stats["energy_residual"] < 1e-8 * run.energy[0]
    # The centre of mass has risen, from R - a to that of the stem, by 10 mm.
    assert run.energy[-1] < run.energy[0]
    rise = (run.position[-1] - run.position[0])[2] - float(scene.body.offset) * (run.axis[-1] - run.axis[0])[2]
    standing = float(scene.body.stem.radius + scene.body.stem.offset) - float(scene.body.radius - scene.body.offset)
    assert_close(rise, standing, rtol=0.02)
