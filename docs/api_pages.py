"""The pages of the API by task, and the public names on each; `conf.py` writes them, `tests/test_manual.py` checks them."""

import importlib
import inspect
import re
from typing import Any, NamedTuple

PACKAGES = ("tippe", "stroller", "nonholonomic")


class Page(NamedTuple):
    """A page of the API.

    - `title`: the heading.
    - `introduction`: what you do with these names.
    - `names`: dotted names, in the order of the page.
    """

    title: str
    introduction: str
    names: list[str]


def of(package: str, names: str) -> list[str]:
    """Dotted names of a package."""
    return [f"{package}.{name}" for name in names.split()]


#: The rooms with the engine of the models.
ENGINE_ROOMS = tuple(
    f"nonholonomic.{room}" for room in ("integration", "hybrid", "derivatives", "sweeps", "identification")
)

#: The public numbers and types of the engine; the docstrings of the rooms say what they mean.
CONSTANTS = [
    *of("nonholonomic.integration", "Components Lanes States"),
    *of("nonholonomic.integration.problem", "RUNNING REACHED_END CROSSED LEFT_DOMAIN FAILED UNRESOLVED"),
    *of("nonholonomic.integration.problem", "DEFAULT_MAX_STEPS MOST_STEPS"),
    "nonholonomic.integration.problem.TIGHTEST",
    *of("nonholonomic.hybrid", "MOST_ROUNDS BETWEEN"),
]

PAGES = {
    "scene": Page(
        "Scenes and launches",
        "A scene is a body, an arena and a friction law. A launch is the start of a run.",
        [*of("tippe", "Scene Launch"), *of("stroller", "Scene Launch"), "tippe.presets", "stroller.presets"],
    ),
    "bodies": Page(
        "Bodies",
        "The bodies that a scene can hold: tops, convex bodies of revolution, bodies of any inertia, and the stroller.",
        [*of("tippe", "Top Stem SpheroidBody ConvexBody Ellipsoid RigidBody"), "stroller.Stroller"],
    ),
    "arenas": Page(
        "Arenas",
        "The surfaces on which tops and strollers move. All packages share them: `tippe.Plane` is `nonholonomic.Plane`.",
        of("nonholonomic", "Plane Cylinder Sphere Spheroid Torus Paraboloid Graph Implicit AbstractSurface"),
    ),
    "friction": Page(
        "Friction",
        "Friction laws for the top and damping for the stroller.",
        [
            *of("tippe", "Frictionless Viscous Coulomb SetValuedCoulomb Contensou Rolling NoSlip AbstractFriction"),
            *of("stroller", "Frictionless Damping RollingResistance AbstractFriction"),
        ],
    ),
    "simulate": Page(
        "Single runs",
        "Simulate one run, and read its motion, forces and energy.",
        [
            *of("nonholonomic", "simulate Trajectory"),
            *of("tippe", "simulate Trajectory HybridTrajectory"),
            *of("stroller", "simulate Trajectory Motion Steady ImplicitMidpoint"),
            "tippe.Status",
        ],
    ),
    "sweeps": Page(
        "Tables",
        "Simulate many runs at once, in memory or into a file. :doc:`tables` lists the variables, the statuses and the file "
        "format.",
        [
            "nonholonomic.sweep",
            *of("tippe", "inversion_table reversal_table trajectory_table"),
            "stroller.sweep",
            "tippe.Table",
            *of("nonholonomic", "local_processes enable_compilation_cache"),
        ],
    ),
    "derivatives": Page(
        "Times, derivatives and stability",
        "Differentiable times of events, Lyapunov exponents and steady states.",
        [
            *of(
                "nonholonomic",
                "event_time crossings bifurcation basins periodic_orbit Orbit Branch SpecialPoint lyapunov_exponent "
                "lyapunov_spectrum LyapunovSpectrum",
            ),
            *of(
                "tippe",
                "inversion_time reversal_time extended_inversion_time lyapunov_exponent LyapunovExponent steady",
            ),
            *of(
                "tippe.steady",
                "group proportions folds upright_critical_spin inverted_critical_spin jellett_thresholds standing_state "
                "standing_matrix growth_rate Tumbling tumbling tumbling_is_stable effective_energy tumbling_angles "
                "tumbling_state quarter_turn tumbling_matrix",
            ),
        ],
    ),
    "fitting": Page(
        "Fitting",
        "Estimate parameters from recordings and measured times.",
        [
            *of("nonholonomic", "identify Recording EventTimes log_density"),
            *of("tippe", "identify Recording read_recording InversionTimes read_inversion_times ReversalTimes Free"),
            *of("tippe", "log_density FitWarning"),
            *of("stroller", "identify Recording read_recording log_density"),
        ],
    ),
    "views": Page(
        "Interactive pages",
        "Pages with sliders. To draw a run or a table, call its own methods: see `view`, `animate`, `plot` and `portrait` of "
        ":doc:`runs <simulate>` and `plot` of :doc:`tables <sweeps>`.",
        ["nonholonomic.explore", "tippe.explore", "stroller.explore"],
    ),
    "planning": Page(
        "Motion planning",
        "Plan the drive of a stroller to a goal, around obstacles and within limits, and keep a ride on the plan.",
        of("stroller", "plan Plan Goal Box Disc Footprint Limits track learn_planner Planner"),
    ),
    "engine": Page(
        "The engine",
        "Use these names to write a model that is as fast as the top and the stroller; its functions take all runs at once. "
        ":doc:`Your own systems <own_systems>` need none of them. In each section, every example continues the one before.",
        [
            "nonholonomic.integration",
            *of(
                "nonholonomic.integration",
                "AbstractProblem CoreProblem AbstractPassive ExtendedProblem Settings "
                "solve_ensemble solve_with_samples Outcome "
                "crossing_time LaneState Jumps solve_by_diffrax follow DenseSolution sample explicit_tableau Oscillatory8 "
                "Stabilized8",
            ),
            "nonholonomic.integration.problem",
            *of(
                "nonholonomic.integration.problem",
                "legal_run run_bounds tolerance_bound require_run require_times require_adaptive require_adjoint",
            ),
            "nonholonomic.integration.dense",
            *of("nonholonomic.integration.dense", "all_crossings few_trials halved sign_changes"),
            "nonholonomic.hybrid",
            *of(
                "nonholonomic.hybrid",
                "AbstractBatchedMode AbstractHoppingMode Transition TransitionPath solve_hybrid "
                "HybridOutcome solve_hybrid_with_tangents solve_hybrid_dense HybridPath "
                "Segment hybrid_resets solve_hybrid_with_samples hybrid_samples",
            ),
            "nonholonomic.derivatives",
            *of(
                "nonholonomic.derivatives",
                "solve_ensemble_with_tangents tangents_of tangent_scale in_groups "
                "VariationalProblem AbstractDifferentiableSolve differentiable_solve tangents_by sampled_run "
                "SampledRun growth exponent_of",
            ),
            "nonholonomic.sweeps",
            *of(
                "nonholonomic.sweeps",
                "sweep Axis axis Variable size_of cells_to_check scattered_cells chunk_for saved_cells AnotherRun Quantity "
                "chosen run_table Tabular",
            ),
            "nonholonomic.identification",
            *of(
                "nonholonomic.identification",
                "AbstractRecording Quantities as_quantity read_columns read_launches identify Identification Measurements "
                "LogDensity sample Draws",
            ),
        ],
    ),
    "own_systems": Page(
        "Your own systems",
        "The classes of systems that you write. The functions of `nonholonomic` run, time, sweep and fit them.",
        [
            *of("nonholonomic", "AbstractMode Hybrid AbstractSystem"),
            *of("nonholonomic.runs", "AbstractModel model_of"),
        ],
    ),
}


RUN = "to_table to_xarray save view animate explore plot portrait"
TOP = (
    "theta theta_rate eta azimuth spin position velocity normal axis angular_velocity angular_momentum slip normal_force "
    "energy jellett jellett_drift inversion_time"
)

#: The members that users need; classes that are not listed show none.
MEMBERS = {
    "tippe.Scene": "state field energy jellett theta spin normal_force slip_velocity friction_power",
    "tippe.Launch": "degrees",
    "tippe.Top": "turned",
    "nonholonomic.Spheroid": "from_oblate",
    "nonholonomic.AbstractSurface": "axes sides coordinates up normal normal_rate elevation gaussian_curvature nearest "
    "distance place_at charted in_fixed_frame in_own_axes",
    "tippe.AbstractFriction": "set_valued isotropic per_normal_force",
    "stroller.AbstractFriction": "dissipates drag",
    "tippe.Trajectory": f"at {RUN} {TOP} contact normal_spin reaction grip",
    "tippe.HybridTrajectory": f"at {RUN} {TOP}",
    "stroller.Scene": "state energy work contact",
    "stroller.Trajectory": f"{RUN} status energy_residual grip grip_margin contact_lost_at rank_lost_at jackknifed_at",
    "stroller.Motion": "position heading steering speed front_speed yaw_rate steering_rate",
    "tippe.Status": "word of",
    "tippe.Table": "shape dims load save to_xarray to_dataframe plot digits",
    "tippe.LyapunovExponent": "exponent error status end_time steps times running",
    "tippe.InversionTimes": "measurements",
    "tippe.ReversalTimes": "measurements",
    "tippe.Free": "start lower upper prior unit",
    "nonholonomic.AbstractMode": "field margin reset",
    "nonholonomic.AbstractSystem": "dimension metric potential constraints drift frame force margin reset impact "
    "lagrangian energy",
    "nonholonomic.integration.AbstractProblem": "leading direction_decides fits_one_kernel start field event_function "
    "crossing_along domain_margin margins",
    "nonholonomic.integration.AbstractPassive": "rates",
    "nonholonomic.integration.Settings": "for_lanes for_single_runs for_steps_alone with_tolerance",
    "nonholonomic.integration.DenseSolution": "at",
    "nonholonomic.hybrid.AbstractBatchedMode": "problem reset_map shown between",
    "nonholonomic.hybrid.AbstractHoppingMode": "most_hops lost hop closed motion_in",
    "nonholonomic.hybrid.HybridPath": "left_domain failed mode_segments times states numbers at",
    "nonholonomic.hybrid.Segment": "at",
    "nonholonomic.derivatives.VariationalProblem": "parts",
    "nonholonomic.sweeps.Quantity": "of",
    "nonholonomic.identification.AbstractRecording": "columns seen labels measurements",
    "nonholonomic.identification.Quantities": "of",
    "nonholonomic.identification.LogDensity": "of log_priors names units start values predict replicate",
    "nonholonomic.sweeps.Tabular": "readable portrait_axes to_table to_xarray save portrait",
    "nonholonomic.derivatives.AbstractDifferentiableSolve": "in_blocks movable absent solve value_and_tangents prefers_adjoint "
    "differentiable push_forward pull_back for_parts",
    "nonholonomic.Trajectory": "status at resets to_table to_xarray save portrait plot explore",
}


def public(package: str) -> list[str]:
    """The names that the `__init__.py` of a package or of a room exports, or that a public module defines."""
    module = importlib.import_module(package)
    names = set(re.findall(r"import (?!__)(\w+) as \1$", inspect.getsource(module), re.M)) or {
        name for name, value in vars(module).items() if name[0] != "_" and getattr(value, "__module__", "") == package
    }
    return sorted(names, key=lambda name: (name.lower(), name))


def resolve(dotted: str) -> Any:
    """The object behind a name such as "tippe.Scene"."""
    home, _, name = dotted.rpartition(".")
    return getattr(importlib.import_module(home), name)


def missing() -> list[str]:
    """Exported names that are on no page, neither themselves nor another name of the same object."""
    shown = {id(resolve(name)) for page in PAGES.values() for name in page.names}
    every = [f"{home}.{name}" for home in (*PACKAGES, "tippe.steady", *ENGINE_ROOMS) for name in public(home)]
    return [name for name in every if name not in CONSTANTS and id(resolve(name)) not in shown]


def text(page: Page) -> str:
    """The page in reStructuredText: a table of its names, then an entry for each; a module has a section with a table of
    its own."""
    introduction = re.sub(r"(:\w+:`[^`]+`)|(`[^`]+`)", lambda match: match[1] or f"`{match[2]}`", page.introduction)
    modules = [name for name in page.names if inspect.ismodule(resolve(name))]
    inside = [name for name in page.names if name not in modules]
    sections = {module: [name for name in inside if name.rpartition(".")[0] == module] for module in modules}
    outside = [name for name in page.names if name in modules or name.rpartition(".")[0] not in modules]
    lines = [page.title, "=" * len(page.title), "", introduction, "", *summary(outside)]
    for name in outside:
        lines += entry(name)
        if sections.get(name):
            # Sphinx looks the names up in the module that it has just documented.
            lines += summary([inner.removeprefix(f"{name}.") for inner in sections[name]])
            lines += [line for inner in sections[name] for line in entry(inner)]
    return "\n".join(lines)


def summary(names: list[str]) -> list[str]:
    """A table of names with their first sentences."""
    return [".. autosummary::", "   :nosignatures:", "", *(f"   {name}" for name in names), ""]


def entry(name: str) -> list[str]:
    """The docstring of a name, with those of its members that users need."""
    value = resolve(name)
    if inspect.ismodule(value):
        heading = f"``{name}``"
        # The names of most modules have entries of their own.
        own = any(other.startswith(f"{name}.") for page in PAGES.values() for other in page.names)
        members = [] if own else ["   :members:"]
        return [heading, "-" * len(heading), "", f".. automodule:: {name}", *members, ""]
    if inspect.isclass(value):
        members = [f"   :members: {', '.join(MEMBERS[name].split())}"] if name in MEMBERS else []
        return [f".. autoclass:: {name}", *members, ""]
    return [f".. autofunction:: {name}", ""]
