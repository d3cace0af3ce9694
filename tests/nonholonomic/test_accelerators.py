"""Programs lower for accelerators on a machine without one: no callbacks to Python, and no operations of CPUs only."""

import re

import accelerator
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import stroller
import tippe
from nonholonomic.integration import Oscillatory8, Settings, solve_ensemble
from stroller.runs.model import RideModel
from tippe.modes.problems import InversionProblem
from tippe.runs.model import modes_of

T1, TOLERANCE, SETTINGS = 8.0, 1e-6, Settings(1e-6, Oscillatory8())
THETAS, TIMES = jnp.linspace(0.05, 0.15, 4), jnp.linspace(0.0, 1.0, 11)

#: mu, a, I1, theta(0), spin: more numbers than are integrated forward.
FIVE = jnp.array([0.3, 0.006, 2.994e-6, 0.1, 155.0])


def scene(mu=0.3, offset=0.006, I1=2.994e-6, law=tippe.Viscous, **options):
    return tippe.Scene(tippe.Top(0.02, 0.02, offset, I1, 3.2e-6), friction=law(mu), **options)


def time(scene, theta=0.1, spin=155.0):
    return tippe.inversion_time(scene, tippe.Launch(theta, spin), T1, tolerance=TOLERANCE)


def ended(problem, count, **options):
    arguments = (problem, jnp.asarray(T1), jnp.asarray(count), SETTINGS)
    return solve_ensemble(*arguments, one_kernel=True, traced=True, **options)[0]


def table(thetas):
    """The program of `inversion_table`."""
    launch = tippe.Launch(thetas, 155.0)
    return ended(InversionProblem.of(scene(), launch, 3.0, len(thetas)), len(thetas))


def table_of_rides(speeds):
    """The program of `stroller.sweep`."""
    body = stroller.Stroller(12.0, 0.7, 1.5, 0.05)
    ride = stroller.Scene(body, stroller.Spheroid(6.0, 3.0), stroller.Damping(0.8, 0.4, 0.1, 0.02), side="inside")
    launch = stroller.Launch((0.0, -1.0), 0.3, speeds, 0.2, 0.5)
    return ended(RideModel.of(ride, launch, None).problem(len(speeds), ()), len(speeds), nonterminal=True)


def hybrid_table(law, thetas):
    """The programs of a table of runs with several modes: to the end of each mode, and on to the next."""
    flying = scene(law=law, contact="hybrid") if law is tippe.Viscous else scene(law=law)
    launch, cells = tippe.Launch(thetas, 155.0), len(thetas)
    problem = InversionProblem.of(flying, launch, 3.0, cells)
    modes, _ = modes_of(flying, problem, TOLERANCE, False)
    left = jnp.full(cells, T1)
    return [(ended(mode.problem(problem.states), cells), mode.reset_map(problem.states, left)) for mode in modes]


def theta_at(times):
    return lambda theta: tippe.simulate(scene(), tippe.Launch(theta, 155.0), 1.0, times, tolerance=TOLERANCE).theta


PROGRAMS = {
    "table": (table, THETAS),
    "table of rides": (table_of_rides, THETAS + 1.0),
    "gradient by one": (jax.grad(lambda mu: time(scene(mu))), 0.3),
    "gradients by five": (jax.vmap(jax.grad(lambda x: time(scene(*x[:3]), x[3], x[4]))), jnp.stack([FIVE] * 4)),
    "samples": (jax.vmap(theta_at(TIMES)), THETAS),
    "hybrid table": (lambda thetas: hybrid_table(tippe.Viscous, thetas), THETAS),
}
LONGER = {
    "times": (jax.vmap(lambda theta: time(scene(), theta)), THETAS),
    "set-valued table": (lambda thetas: hybrid_table(tippe.SetValuedCoulomb, thetas), THETAS),
    "hybrid times": (jax.vmap(lambda theta: time(scene(contact="hybrid"), theta)), THETAS),
    "hybrid gradient": (jax.grad(lambda mu: time(scene(mu, contact="hybrid"))), 0.3),
    "set-valued gradient": (jax.grad(lambda mu: time(scene(mu, law=tippe.SetValuedCoulomb))), 0.3),
    "gradient of samples": (jax.grad(lambda theta: jnp.sum(theta_at(TIMES)(theta))), 0.1),
}


def lowered(program, arguments, *platforms):
    return export.export(jax.jit(program), platforms=platforms)(arguments).mlir_module()


def foreign(text):
    """The custom calls of a program, and the attributes that only one compiler understands."""
    return set(re.findall(r"custom_call @(\w+)|(xla_cpu_\w+|frontend_attributes)", text))


@pytest.mark.oldest
@pytest.mark.parametrize("name", PROGRAMS)
def test_programs_lower_for_accelerators(name):
    text = lowered(*(PROGRAMS | LONGER)[name], "cuda", "tpu")
    assert "stablehlo.while" in text
    assert foreign(text) == set()


@pytest.mark.slow
@pytest.mark.parametrize("name", LONGER)
def test_longer_programs_lower_for_accelerators(name):
    test_programs_lower_for_accelerators(name)


@pytest.mark.slow
@pytest.mark.parametrize("name", PROGRAMS | LONGER)
def test_programs_traced_on_an_accelerator_lower_there(name, monkeypatch):
    """There the stages of a step are written out, and there are more lanes."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    jax.clear_caches()
    test_programs_lower_for_accelerators(name)
    jax.clear_caches()


def test_what_does_not_belong_there_is_seen():
    """A callback, a factorisation by LAPACK, and the attributes with which a CPU compiles a table."""

    def called_back(x):
        return jax.pure_callback(np.sin, x, x)

    with pytest.raises(NotImplementedError, match="callback"):
        lowered(called_back, THETAS, "cpu")
    assert foreign(lowered(lambda x: jnp.linalg.solve(jnp.eye(4) + x, x), THETAS, "cpu"))
    assert ("", "xla_cpu_small_call") in foreign(lowered(*PROGRAMS["table"], "cpu"))


def test_the_benchmark_says_that_there_is_no_accelerator(tmp_path, capsys):
    if jax.default_backend() != "cpu":
        pytest.skip("there is one")
    accelerator.main(["--out", str(tmp_path / "page.md"), "--launches", "8"])
    assert "No accelerator" in capsys.readouterr().out
    assert not any(tmp_path.iterdir())


def test_the_benchmark_names_what_it_leaves_out():
    """Without time left, nothing runs, and the page states that."""
    omissions = list(accelerator.measured({"table": lambda launches, tolerance: None}, (8,), (1e-6,), 0.0))
    assert omissions == ["table, 8 launches, tolerance 1e-06"]
    assert "No time was left for: table, 8 launches, tolerance 1e-06." in accelerator.page([], omissions)


@pytest.mark.slow
def test_the_benchmark_measures_every_program():
    """On a CPU, with few launches; a hundredfold tolerance shows in the error."""
    rows = list(accelerator.measured(accelerator.programs(), (8,), (1e-4, 1e-8), 1e9))
    assert len(rows) == 2 * len(accelerator.programs())
    for loose_row, tight_row in zip(rows[::2], rows[1::2], strict=True):
        assert tight_row.error < 1e-5
        assert tight_row.error < loose_row.error, loose_row
    page = accelerator.page(rows, [])
    assert all(f"| {name} " in page for name in accelerator.programs())
