"""Tables by kernels: the text for a GPU, compiled for the host, gives the tables of the CPU; NVIDIA's compiler accepts it."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_kernels import FakeDriver, needs_compiler, run_on_host
from models import CASES
from rigid import rattleback
from tops import rutstam_top

import nonholonomic
import stroller
import tippe
from nonholonomic.kernels import device_code, gpu
from nonholonomic.kernels.device_code import Kernel

TOP = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
HOPPING = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3), contact="hybrid", restitution=0.1)
CYLINDER = tippe.Scene(rutstam_top(), tippe.Cylinder(0.3), friction=tippe.Coulomb(0.3, 0.02))
RIDER = stroller.Scene(
    stroller.Stroller(mass=12.0, wheelbase=0.7, inertia=1.5, steering_inertia=0.05),
    friction=stroller.Damping(2.0, 1.0, 0.2, 0.05),
)
START = stroller.Launch(place=(0.0, 0.0), heading=0.3, speed=2.0)


class Pulse(nonholonomic.AbstractMode):
    """A pulse of 0.05 s, found by its comparisons of the time."""

    def field(self, t, y):
        return jnp.array([jnp.where((t > 1.0) & (t < 1.05), 10.0, 0.0)])


def top(theta=(0.2, 0.5, 0.9), spin=155.0, t1=3.0, scene=TOP, **options):
    return tippe.inversion_table(scene, theta=list(theta), spin=spin, t1=t1, progress=False, **options)


def of_case(name, **options):
    case = CASES[name]
    axes = {case.parameter: np.linspace(0.9, 1.05, 3) * case.value}
    return nonholonomic.sweep(case.system, case.start, case.t1, axes=axes, event=case.event, progress=False, **options)


class Room(nonholonomic.AbstractMode):
    """A ball between four walls, two of which it strikes at once if it starts on a diagonal."""

    def field(self, t, s):
        return jnp.array([s[2], s[3], 0.0, 0.0])

    def margin(self, t, s):
        return {"left": 1.0 + s[0], "down": 1.0 + s[1], "right": 1.0 - s[0], "up": 1.0 - s[1]}

    def reset(self, t, s, exit):
        is_side = exit["left"] | exit["right"]
        return s * jnp.where(is_side, jnp.array([1.0, 1.0, -1.0, 1.0]), jnp.array([1.0, 1.0, 1.0, -1.0])), 0


#: Tables: smooth tops with error bounds, the last of several crossings, two slopes; hops; a rigid body; rides; own systems with
#: resets and constraints.
TABLES = {
    "top": lambda **device: top(errors=True, **device),
    "last": lambda **device: top(crossing="both", **device),
    "slopes": lambda **device: top(sensitivities=["scene.friction.mu", "launch.theta"], **device),
    "cylinder": lambda **device: top((0.1, 0.2), 199.0, 1.0, CYLINDER, eta=0.1, **device),
    "samples": lambda **device: tippe.trajectory_table(
        TOP,
        theta=[0.2, 0.9],
        spin=155.0,
        times=[0.0, 0.1, 0.5, 2.5],
        quantities=["theta", "energy", "position"],
        progress=False,
        **device,
    ),
    "times of a pulse": lambda **device: nonholonomic.sweep(
        nonholonomic.Hybrid([Pulse()]),
        [0.0],
        2.0,
        axes={"start[0]": [0.0, 1.0]},
        times=[0.0, 1.0, 1.02, 1.05, 1.2, 2.0],
        quantities=["y0"],
        progress=False,
        **device,
    ),
    "times of a sleigh": lambda **device: of_case("mechanics", times=[0.5, 1.0, 2.0], quantities=["q2"], **device),
    "hops": lambda **device: top((1.4, 1.5, 1.55), 290.0, 0.4, HOPPING, **device),
    "rattleback": lambda **device: tippe.reversal_table(
        rattleback(), theta=0.02, spin=[-5.0, 5.0], t1=9.0, tolerance=1e-6, progress=False, **device
    ),
    "ride": lambda **device: stroller.sweep(
        RIDER, START, 1.0, axes={"launch.speed": [1.0, 2.0]}, progress=False, **device
    ),
    "room": lambda **device: nonholonomic.sweep(
        nonholonomic.Hybrid([Room()]),
        [0.0, 0.1, 1.3, 0.7],
        5.0,
        axes={"start[1]": [0.0, 0.5]},
        progress=False,
        **device,
    ),
    "ball": lambda **device: of_case("modes", sensitivities=["restitution"], **device),
    "sleigh": lambda **device: of_case("mechanics", **device),
}
LONG = {
    "stick-slip": lambda **device: of_case("sticking top", **device),
    "impacts": lambda **device: of_case("impacts", errors=True, **device),
    "turntable": lambda **device: of_case("turntable", sensitivities=["drag"], **device),
    "slopes of hops": lambda **device: top(
        (1.4, 1.5), 290.0, 0.4, HOPPING, angle=2.0, sensitivities=["launch.theta"], **device
    ),
}
NAMES = [*TABLES, *(pytest.param(name, marks=pytest.mark.slow) for name in LONG)]

#: How far tables may differ, relative to the largest number of a variable: by round-off; and where runs with variations take
#: other steps, which on the CPU are those of the table and in kernels are only those of the slopes.
CLOSE, OF_OTHER_STEPS = 1e-9, 1e-7


#: Tables of samples, on which the steps of the CPU end.
SAMPLED = ("samples", "times of a sleigh", "times of a pulse")


@pytest.fixture
def on_host(monkeypatch):
    """The kernels that are run, on the host in place of a GPU."""
    texts = []

    def run(kernel, *numbers):
        texts.append(kernel.text)
        return run_on_host(kernel, *numbers)

    monkeypatch.setattr(gpu, "first_gpu", lambda: run)
    return texts


@needs_compiler
@pytest.mark.parametrize("name", NAMES)
def test_kernels_give_the_tables_of_the_cpu(name, on_host):
    compare_with_the_cpu(name)
    assert on_host
    for architecture in ("sm_80", "sm_90") if importlib.util.find_spec("cuda") is not None else ():
        assert all(gpu.compiled(text, architecture).startswith(b"\x7fELF") for text in dict.fromkeys(on_host))


@pytest.mark.gpu
@pytest.mark.parametrize("name", [*TABLES, *LONG])
def test_a_gpu_gives_the_tables_of_the_cpu(name):
    compare_with_the_cpu(name)


def compare_with_the_cpu(name):
    table_of = (TABLES | LONG)[name]
    expected, table = table_of(device="cpu"), table_of(device="gpu")
    assert list(table.variables) == list(expected.variables)
    has_slopes = any("_by_" in variable for variable in expected.variables)
    for variable, values in expected.variables.items():
        if values.dtype.kind == "U" or variable in ("grazes", "hops", "switches", "sticks"):
            assert np.array_equal(table[variable], values), variable
        elif values.dtype.kind in "iu":
            if has_slopes or name in SAMPLED:
                continue
            # Where round-off decides, a step on the way to an event more or less.
            np.testing.assert_allclose(table[variable], values, atol=8, err_msg=variable)
        elif variable.endswith("_error"):
            # Differences of runs are as large, not equal.
            assert np.array_equal(np.isfinite(table[variable]), np.isfinite(values)), variable
            assert np.all(np.where(np.isfinite(values), table[variable], 0.0) <= 1e-7), variable
        else:
            scale = np.max(np.abs(values[np.isfinite(values)]), initial=1e-3)
            close = (OF_OTHER_STEPS if has_slopes or name in SAMPLED else CLOSE) * scale
            assert np.array_equal(np.isnan(table[variable]), np.isnan(values))
            np.testing.assert_allclose(table[variable], values, rtol=0.0, atol=close, err_msg=variable)


@needs_compiler
def test_a_new_call_makes_no_new_kernel(on_host):
    top(device="gpu"), top((0.3, 0.4, 0.6), spin=170.0, tolerance=1e-8, device="gpu")
    assert len(set(on_host)) == 1


@needs_compiler
def test_only_large_tables_go_to_a_gpu_by_themselves(on_host, monkeypatch):
    top(t1=0.1)
    assert not on_host
    monkeypatch.setattr(gpu, "LEAST_CELLS", 4)
    table = top(np.linspace(0.2, 0.6, 9), t1=0.1)
    assert on_host
    assert np.array_equal(table.status, np.full(9, "not_inverted"))
    assert len(table.end_theta) == 9


def test_what_cannot_run_by_a_kernel_runs_by_the_loops_of_jax(monkeypatch):
    def fails(kernel, *numbers):
        raise gpu.KernelError("the GPU reports CUDA_ERROR_OUT_OF_MEMORY")

    expected = top(t1=0.1)
    monkeypatch.setattr(gpu, "first_gpu", lambda: fails)
    with pytest.warns(UserWarning, match=r"JAX's loops .* CUDA_ERROR_OUT_OF_MEMORY"):
        table = top(t1=0.1, device="gpu")
    assert np.array_equal(table.end_theta, expected.end_theta)

    class Gamma(nonholonomic.AbstractMode):
        def field(self, t, y):
            return -jax.lax.digamma(y + 2.0)

    monkeypatch.setattr(gpu, "first_gpu", lambda: run_on_host)
    with pytest.warns(UserWarning, match="'digamma' of JAX cannot be written in CUDA C"):
        table = nonholonomic.sweep(
            nonholonomic.Hybrid([Gamma()]), [1.0], 0.1, axes={"start[0]": [1.0, 2.0]}, device="gpu"
        )
    assert list(table.status) == ["completed", "completed"]


def test_a_program_that_is_too_long_runs_by_the_loops_of_jax(monkeypatch):
    monkeypatch.setattr(gpu, "first_gpu", lambda: run_on_host)
    monkeypatch.setattr(device_code, "MOST_TEXT", 1000)
    # Kernels of other tests are kept.
    device_code.kernel_of.cache_clear()
    with pytest.warns(UserWarning, match=r"JAX's loops .* characters is too long"):
        table = top(t1=0.25, crossing="last", device="gpu")
    assert list(table.status) == ["not_inverted"] * 3


@needs_compiler
def test_large_functions_are_called(on_host, monkeypatch):
    monkeypatch.setattr(device_code, "MOST_IN_STEPS", 10)
    # Kernels of other tests are kept.
    device_code.kernel_of.cache_clear()
    compare_with_the_cpu("times of a sleigh")
    assert all("CALLED static void field" in text for text in on_host)
    for text in dict.fromkeys(on_host) if importlib.util.find_spec("cuda") is not None else ():
        assert gpu.compiled(text, "sm_90").startswith(b"\x7fELF")
    device_code.kernel_of.cache_clear()


def test_samples_without_a_kernel_say_so(on_host):
    case = CASES["modes"]
    axes = {case.parameter: [0.7, 0.8]}
    with pytest.warns(UserWarning, match="no kernel computes these samples"):
        table = nonholonomic.sweep(
            case.system, case.start, 1.0, axes=axes, times=[0.5], quantities=["y0"], device="gpu", progress=False
        )
    assert not on_host
    assert list(table.status) == ["completed", "completed"]


def test_devices_are_checked(monkeypatch):
    with pytest.raises(ValueError, match="device = 'tpu' must be 'cpu', 'gpu'"):
        top(device="tpu")
    monkeypatch.setattr(gpu, "first_gpu", lambda: None)
    with pytest.raises(ValueError, match=r"device = 'gpu': none is found .* pip install"):
        top(device="gpu")


def test_the_environment_chooses_the_platform(monkeypatch):
    assert gpu.first_gpu() is None
    gpu.first_gpu.cache_clear()
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: pytest.fail("JAX_PLATFORMS leaves GPUs out"))
    assert gpu.first_gpu() is None
    gpu.first_gpu.cache_clear()


@needs_compiler
def test_launches_cover_all_cells_in_slices(monkeypatch):
    text = """
    #include <cmath>
    extern "C" void run_cells(const double* shared, const double* columns, double* results, long long capacity,
                              unsigned long long end, unsigned long long* queue) {
      for (unsigned long long cell = (*queue)++; cell < end; cell = (*queue)++) results[cell] = shared[0] * columns[cell];
    }
    """
    driver = FakeDriver()
    monkeypatch.setattr(gpu, "compiled", lambda text, architecture: text.encode())
    device = gpu.Gpu(driver)
    assert (device.architecture, device.processors) == ("sm_90", 132)
    numbers = np.arange(40_000.0)[None]
    results = device(Kernel(text, 1), np.array([3.0]), numbers, 39_000)
    assert np.array_equal(results[0, :39_000], 3.0 * numbers[0, :39_000])
    assert not results[0, 39_000:].any()
    assert driver.launches == [(528, 64), (82, 64)]
    assert not driver.memory
    with pytest.raises(gpu.KernelError, match="CUDA_ERROR_OUT_OF_MEMORY"):
        device(Kernel(text, 1), np.array([3.0]), np.zeros((1, 1 << 20)), 1)
    assert not driver.memory


def test_jax_stays_where_it_is_inside_of_jit(monkeypatch):
    """`status_line` moves calls to the CPU if JAX's default is another device."""
    from nonholonomic.compilation import xla_cpu

    places = []

    def seen(x):
        with xla_cpu.on_cpu():
            places.append(xla_cpu.chosen_device())
        return x

    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    seen(1.0)
    jax.jit(seen)(1.0)
    with jax.default_device(jax.devices("cpu")[0]):
        assert xla_cpu.current_platform() == "cpu"
        seen(1.0)
    cpu = jax.devices("cpu")[0]
    assert places == [cpu, None, cpu]
    assert jnp.ones(1).devices() == {cpu}
