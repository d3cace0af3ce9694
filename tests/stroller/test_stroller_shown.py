"""An input that cannot be used is refused in words; a ride goes to xarray and a file; the command refuses bad paths first."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest
import xarray

import stroller
from stroller.__main__ import main

BODY = stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05)
SCENE = stroller.Scene(BODY, friction=stroller.Damping(2.0, 1.0, 0.2, 0.05))
LAUNCH = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)


def branches(t, motion):
    return (1.0, 0.0) if t < 1.0 else (0.0, 0.0)


BAD = [
    (3.0, r"input = 3\.0 must be a function \(t, motion\) -> \(drive force \[N\], steering torque \[N m\]\), or None"),
    (branches, "input = branches cannot be traced by JAX: .* jnp.where in place of `if`"),
    (lambda t, motion: (math.sin(t), 0.0), "cannot be traced by JAX"),
    (lambda t, motion: (np.asarray(t), 0.0), "cannot be traced by JAX"),
    (lambda t: (1.0, 0.0), r"must be a function \(t, motion\)"),
    (lambda t, motion: motion.speed, r"one drive force .* and one steering torque .*, as a pair, not a number of type"),
    (lambda t, motion: 1.0, "must return"),
    (lambda t, motion: (1.0, 2.0, 3.0), "one drive force .* and one steering torque"),
    (lambda t, motion: (jnp.ones(2), 0.0), r"not shapes \[\(2,\), \(\)\]"),
    (lambda t, motion: (jnp.nan, 0.0), r"must be finite: at the start it gives \(nan, 0\)"),
    (lambda t, motion: (1.0 / t, 0.0), r"must be finite: at the start it gives \(inf, 0\)"),
]


@pytest.mark.parametrize(("controls", "message"), BAD)
def test_an_input_that_cannot_be_used_is_refused(controls, message):
    with pytest.raises(ValueError, match=message):
        stroller.simulate(SCENE, LAUNCH, 1.0, controls)
    with pytest.raises(ValueError, match=message):
        stroller.sweep(SCENE, LAUNCH, 1.0, axes={"launch.speed": [1.0, 2.0]}, input=controls)


def test_a_ride_goes_to_xarray_a_file_and_a_picture(tmp_path):
    run = stroller.simulate(SCENE, LAUNCH, 1.0, stroller.Steady(1.0, 0.1), times=[0.5, 1.0], tolerance=1e-6)
    data = run.to_xarray()
    assert data["side_force"].dims == ("time", "axle")
    assert data["speed"].attrs == {"units": "m s-1", "long_name": "speed v"}
    assert list(data["coordinate"].values) == ["x", "y"]
    assert list(run.to_dataframe()["side_force.rear"]) == list(run.side_force[:, 0])
    assert f"{int(run.stats.steps)} accepted, {int(run.stats.rejected)} rejected" in str(run)
    assert f"{run.energy[0]:.6g} J at the start, {run.energy[-1]:.6g} J at the end" in str(run)
    # Completion in a notebook knows the quantities.
    assert {"speed", "power", "at"} <= set(dir(run))
    assert run.plot("heading", unit="deg").axes[0].get_ylabel() == "heading ψ [deg]"
    # The same ride at other times.
    later = run.at([0.25, 0.5, 1.0])
    np.testing.assert_array_equal(later.position[1:], run.position)
    np.testing.assert_array_equal(run.at(0.25).speed, later.speed[:1])
    with pytest.raises(ValueError, match=r"times = 1\.5 must be at most 1\.0 \(the ride ends there\)"):
        run.at(1.5)
    run.save(tmp_path / "ride.h5")
    with xarray.open_dataset(tmp_path / "ride.h5", engine="h5netcdf") as dataset:
        np.testing.assert_array_equal(dataset["position"], run.position)
        assert set(dataset.variables) == set(data.variables)
        assert json.loads(dataset.attrs["request"])["launch.speed"] == float(run.model.launch.speed)
    assert run.portrait("position.x", "position.y").axes[0].get_ylabel() == "position of the rear axle, y [m]"
    assert "completed" in run._repr_html_()
    assert "Damping(rolling=2 N s/m, front=1 N s/m, scrub=0.2 N m s, steering=0.05 N m s)" in str(SCENE)


def test_the_command_refuses_what_it_cannot_do_before_it_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("stroller.__main__.simulate", lambda *arguments, **options: pytest.fail("it ran"))
    (tmp_path / "file").write_text("")
    assert main(["--out", str(tmp_path / "file")]) == 2
    assert "--out = " in capsys.readouterr().err
    assert main(["--period", "0", "--out", str(tmp_path)]) == 2
    assert "period = 0.0 must be greater than 0.0" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="0"):
        main(["--version"])
    assert capsys.readouterr().out.strip() == f"nonholonomic {stroller.__version__}"
