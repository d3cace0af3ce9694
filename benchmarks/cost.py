"""A record of machine-independent cost: operations of every field, and steps of the scenes of `work_precision.py`.

    python benchmarks/cost.py [--write]

The script counts operations in what JAX traces (`operations.py`): "field" is one evaluation of the vector field, "step" one
attempted step of one launch. "steps" is the mean number of steps, including rejected ones, of 64 launches at a tolerance of
1e-9. The script prints what differs from `cost.json`; `--write` replaces the file. `tests/test_cost.py` fails if a number has
grown by more than 2 %.
"""

import argparse
import functools
import json
from collections.abc import Callable, Iterator
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
from arenas import ARENAS
from operations import Operations, operations_of_field, operations_per_step
from scenes import ANGLE, TOP, Case, scenes

import stroller
import tippe
from nonholonomic.derivatives import VariationalProblem, tangents_of
from nonholonomic.geometry import AbstractSurface
from nonholonomic.integration import AbstractProblem, Oscillatory8, Settings, solve_ensemble
from nonholonomic.parameters import with_numbers
from stroller.runs.model import RideModel
from tippe.modes.problems import InversionProblem
from tippe.runs.model import TopModel, modes_of

RECORD = Path(__file__).with_name("cost.json")

#: Relative growth that is allowed.
GROWTH = 0.02

#: Number of launches whose steps are counted: one chunk of a table.
LAUNCHES = 64

#: Number of operations for a slow function (`operations.FUNCTIONS`).
FUNCTION = 20

#: A function without arguments that returns problems, whose numbers may be shapes alone.
Problems = Callable[[], tuple[AbstractProblem, ...]]

LAWS = {
    "Coulomb": tippe.Coulomb(0.3, 0.1),
    "Contensou": tippe.Contensou(0.3, 5e-4, 0.1),
    "rolling resistance": tippe.Rolling(1e-4, 1.0, tippe.Coulomb(0.3, 0.1)),
    "set-valued": tippe.SetValuedCoulomb(0.3),
}

EGG = tippe.SpheroidBody(mass=0.05, equatorial=0.02, polar=0.028, I1=1.184e-5, I3=8e-6, offset=0.003)
RATTLEBACK = tippe.Ellipsoid(
    mass=1.0,
    semi_axes=(0.2, 0.03, 0.02),
    centre_of_mass=(0.0, 0.0, -0.01),
    inertia=((2e-4, -2e-5, 0.0), (-2e-5, 1.6e-3, 0.0), (0.0, 0.0, 1.7e-3)),
)
ON_A_STEM = tippe.Top(6e-3, 0.015, 3e-3, 8e-7, 7e-7, stem=tippe.Stem(radius=5e-3, offset=0.016))

GROUNDS = {
    "plane": stroller.Plane(),
    "tilted plane": stroller.Plane(0.3),
    "cylinder": stroller.Cylinder(2.0),
    "sphere": stroller.Sphere(2.0),
    "spheroid": stroller.Spheroid(2.0, 1.1),
    "torus": stroller.Torus(3.0, 1.0),
    "paraboloid": stroller.Paraboloid(0.5),
    "graph": stroller.Graph(lambda x, y: 0.1 * x * x - 0.2 * y * y),
}


def fields() -> Iterator[tuple[str, Problems]]:
    """Every field by name: of tops and a rattleback on arenas and under laws, with derivatives, and of strollers."""
    top, viscous = tippe.Top(*TOP), tippe.Viscous(0.3)
    tops = {f"top, {name}": tippe.Scene(top, arena, viscous) for name, arena in ARENAS.items()}
    tops |= {f"top, plane, {name}": tippe.Scene(top, tippe.Plane(), law) for name, law in LAWS.items()}
    tops |= {"egg": tippe.Scene(EGG, tippe.Plane(), viscous)}
    laws = {"": viscous, ", rolling": tippe.NoSlip(), ", set-valued": LAWS["set-valued"]}
    tops |= {f"rattleback{name}": tippe.Scene(RATTLEBACK, friction=law) for name, law in laws.items()}
    tops |= {"rattleback, sphere": tippe.Scene(RATTLEBACK, tippe.Sphere(3.0), viscous)}
    tops |= {"top, sphere, with flights": tippe.Scene(top, tippe.Sphere(0.3), viscous, contact="hybrid")}
    tops |= {"top with a stem": tippe.Scene(ON_A_STEM, tippe.Plane(), LAWS["Coulomb"], contact="hybrid")}
    for name, scene in tops.items():
        yield name, functools.partial(of_top, scene)
    for count in (1, 2):
        yield f"top, plane, derivatives by {count}", functools.partial(of_derivatives, tops["top, plane"], count)
    for name, ground in GROUNDS.items():
        yield f"stroller, {name}", functools.partial(of_stroller, ground)


def of_top(scene: tippe.Scene) -> tuple[AbstractProblem, ...]:
    """The problems that a table of the scene integrates: one, or one per mode."""
    place = (0.0, 0.0, 0.0) if isinstance(scene.surface, tippe.Implicit) else None
    return eqx.filter_eval_shape(_problems_of_top, scene, tippe.Launch(0.3, 100.0, place=place))


def _problems_of_top(scene: tippe.Scene, launch: tippe.Launch) -> tuple[AbstractProblem, ...]:
    problem = InversionProblem.of(scene, launch, ANGLE, LAUNCHES)
    if TopModel(scene=scene, launch=launch).smooth:
        return (problem,)
    modes, _ = modes_of(scene, problem, 1e-9, False)
    return tuple(mode.problem(problem.states) for mode in modes)


def of_derivatives(scene: tippe.Scene, count: int) -> tuple[AbstractProblem, ...]:
    """The problem with its variations along the first of some numbers."""
    names = ["scene.friction.mu", "scene.body.offset"][:count]
    return eqx.filter_eval_shape(functools.partial(_variational, names), scene, tippe.Launch(0.3, 100.0))


def _variational(names: list[str], scene: tippe.Scene, launch: tippe.Launch) -> tuple[AbstractProblem, ...]:
    def build(*numbers: float) -> InversionProblem:
        cells = with_numbers({"scene": scene, "launch": launch}, dict(zip(names, numbers, strict=True)))
        return InversionProblem.of(cells["scene"], cells["launch"], ANGLE, LAUNCHES)

    point = tuple(jnp.ones(()) for _ in names)
    directions = [tuple(jnp.asarray(float(row == k)) for k in range(len(names))) for row in range(len(names))]
    return (VariationalProblem(build(*point), tangents_of(build, point, directions), True),)


def of_stroller(ground: AbstractSurface) -> tuple[AbstractProblem, ...]:
    """The problem that a table of rides integrates."""
    body = stroller.Stroller(12.0, 0.7, 1.5, 0.05, steering_spring=0.2)
    scene = stroller.Scene(body, ground, stroller.Damping(0.8, 0.4, 0.1, 0.02))
    launch = stroller.Launch((0.3, 0.5), 0.3, 1.5, 0.2, 0.5)
    return (eqx.filter_eval_shape(lambda *roots: RideModel.of(*roots, None).problem(LAUNCHES, ()), scene, launch),)


def counts_of_field(problems: Problems) -> list[int]:
    """Operations of the field, or of the field of each mode; a slow function counts as 20."""
    return [rounded(operations_of_field(problem)) for problem in problems()]


def counts_of_step(problems: Problems) -> list[int]:
    """Operations of an attempted step, counted in the same way."""
    return [rounded(operations_per_step(problem, 1 + len(getattr(problem, "tangents", ())))) for problem in problems()]


def rounded(operations: Operations) -> int:
    return round(operations.arithmetic + FUNCTION * operations.functions)


def steps(case: Case) -> list[float]:
    """Mean number of steps of a launch."""
    run = (jnp.asarray(case.task.t1), jnp.asarray(case.task.launches), Settings(1e-9, Oscillatory8()))
    return [round(float(solve_ensemble(case.problem, *run)[0].steps.mean()), 2)]


def record() -> dict[str, dict[str, list[float]]]:
    """The record in the file."""
    return json.loads(RECORD.read_text())


def has_grown(recorded: list[float], new_counts: list[float]) -> bool:
    """Whether a number has grown by more than 2 %, or the set of numbers has changed."""
    if len(recorded) != len(new_counts):
        return True
    return any(count > (1.0 + GROWTH) * old for old, count in zip(recorded, new_counts, strict=True))


def main() -> None:
    """Count, compare and write."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--write", action="store_true", help="write the record anew")
    options = command.parse_args()
    new_counts = {
        "field": {name: counts_of_field(problems) for name, problems in fields()},
        "step": {name: counts_of_step(problems) for name, problems in fields()},
        "steps": {name: steps(case) for name, case in scenes(LAUNCHES).items()},
    }
    recorded = record() if RECORD.exists() else {}
    for kind, numbers in new_counts.items():
        for name, number in numbers.items():
            old_count = recorded.get(kind, {}).get(name)
            if number != old_count:
                print(f"{kind}, {name}: {old_count} recorded, {number} now")
    if options.write:
        lines = (
            f'  "{kind}": {{\n'
            + ",\n".join(f"    {json.dumps(name)}: {json.dumps(entry)}" for name, entry in entries.items())
            for kind, entries in new_counts.items()
        )
        RECORD.write_text("{\n" + "\n  },\n".join(lines) + "\n  }\n}\n")


if __name__ == "__main__":
    main()
