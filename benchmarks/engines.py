"""The same top in general physics engines (MuJoCo, Drake and PyBullet), compared with rigid Coulomb friction
(`SetValuedCoulomb`).

    python benchmarks/engines.py [--t1 12] [--engines MuJoCo ...] [--out engines.csv]

Rutstam's top on the level plane, Coulomb friction with mu = 0.3 at a point, theta(0) = 0.1, 155 rad/s, centre of mass at rest.
With this friction the top stops slipping within a tenth of a second, rolls, and does not invert
(`docs/concepts/why_it_turns_over.md`). The script prints theta at a few times for every engine and step, the CPU time, and
the error: the greatest difference of theta from `SetValuedCoulomb` at a tolerance of 1e-12, over 241 times. An engine's
contact is compliant; that of MuJoCo gets stiffer as the step shrinks. Engines that are not installed are named and skipped;
the extra `bench` has MuJoCo and Drake, not PyBullet, which has no wheels for recent versions of Python.
"""

import argparse
import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measure import machine, one_core, table, write_csv
from peers import available
from scenes import TOP

import tippe

MASS, RADIUS, OFFSET, I1, I3 = TOP
MU, GRAVITY, THETA, SPIN = 0.3, 9.81, 0.1, 155.0

#: The height of the centre of mass at the start, where the sphere touches the plane.
HEIGHT = RADIUS - OFFSET * np.cos(THETA)

#: Number of times at which theta is compared, and indices of the printed ones.
TIMES, PRINTED = 241, (10, 60, 240)

#: The axis at the start, and the unit quaternion (w, x, y, z) that turns z into it.
AXIS = np.array([np.sin(THETA), 0.0, np.cos(THETA)])
QUATERNION = np.array([np.cos(0.5 * THETA), 0.0, np.sin(0.5 * THETA), 0.0])

#: (times [s], step [s]) -> theta at these times [rad].
Engine = Callable[[np.ndarray, float], np.ndarray]


class Measured(NamedTuple):
    """Theta at the times, and the CPU time [s]."""

    theta: np.ndarray
    cpu: float


def mujoco(times: np.ndarray, step: float) -> np.ndarray:
    """MuJoCo with RK4, elliptic cones and impratio 100, with the stiffest contact that its manual allows (2 steps)."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{step}" gravity="0 0 -{GRAVITY}" integrator="RK4" cone="elliptic" impratio="100"
              tolerance="1e-14" iterations="200"/>
            <default><geom friction="{MU} 0 0" condim="3" solref="{2.0 * step} 1" solimp="0.99 0.999 1e-6"/></default>
            <worldbody><geom type="plane" size="10 10 1"/>
              <body pos="0 0 {HEIGHT}" quat="{" ".join(map(str, QUATERNION))}"><freejoint/>
                <inertial pos="0 0 0" mass="{MASS}" diaginertia="{I1} {I1} {I3}"/>
                <geom type="sphere" size="{RADIUS}" pos="0 0 {OFFSET}"/></body></worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    # A free joint's angular velocity is in the frame of the body.
    data.qvel[5] = SPIN
    mujoco.mj_forward(model, data)
    angles = []
    for count in np.diff(np.rint(times / step).astype(int), prepend=0):
        mujoco.mj_step(model, data, int(count))
        angles.append(np.arccos(np.clip(data.xmat[1].reshape(3, 3)[2, 2], -1.0, 1.0)))
    return np.array(angles)


def drake(times: np.ndarray, step: float) -> np.ndarray:
    """Drake's discrete contact (SAP) at a point, with a stiffness such that the top sinks in by 1e-7 m at rest."""
    from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
    from pydrake.math import RigidTransform, RotationMatrix
    from pydrake.multibody.math import SpatialVelocity
    from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
    from pydrake.multibody.tree import SpatialInertia, UnitInertia
    from pydrake.systems.analysis import Simulator
    from pydrake.systems.framework import DiagramBuilder

    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, step)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -GRAVITY])
    inertia = SpatialInertia(MASS, np.zeros(3), UnitInertia(I1 / MASS, I1 / MASS, I3 / MASS))
    body = plant.AddRigidBody("top", inertia)
    contact = ProximityProperties()
    AddContactMaterial(1.0, MASS * GRAVITY / 1e-7, CoulombFriction(MU, MU), contact)
    plant.RegisterCollisionGeometry(body, RigidTransform([0.0, 0.0, OFFSET]), Sphere(RADIUS), "ball", contact)
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "plane", contact)
    plant.Finalize()
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    orientation = RotationMatrix.MakeYRotation(THETA)
    plant.SetFreeBodyPose(context, body, RigidTransform(orientation, [0.0, 0.0, HEIGHT]))
    plant.SetFreeBodySpatialVelocity(context, body, SpatialVelocity(SPIN * AXIS, np.zeros(3)))
    angles = []
    for moment in times:
        simulator.AdvanceTo(moment)
        rotation = plant.EvalBodyPoseInWorld(context, body).rotation().matrix()
        angles.append(np.arccos(np.clip(rotation[2, 2], -1.0, 1.0)))
    return np.array(angles)


def pybullet(times: np.ndarray, step: float) -> np.ndarray:
    """PyBullet without damping, with lengths times 100 (its contact margins are designed for metres)."""
    import pybullet as bullet

    scale = 100.0
    client = bullet.connect(bullet.DIRECT)
    bullet.setGravity(0.0, 0.0, -GRAVITY * scale)
    bullet.setPhysicsEngineParameter(
        fixedTimeStep=step, numSubSteps=0, numSolverIterations=200, erp=0.2, contactERP=0.2
    )
    plane = bullet.createMultiBody(0.0, bullet.createCollisionShape(bullet.GEOM_PLANE))
    ball = bullet.createCollisionShape(
        bullet.GEOM_SPHERE, radius=RADIUS * scale, collisionFramePosition=[0.0, 0.0, OFFSET * scale]
    )
    orientation = [*QUATERNION[1:], QUATERNION[0]]
    top = bullet.createMultiBody(MASS, ball, basePosition=[0.0, 0.0, HEIGHT * scale], baseOrientation=orientation)
    square = scale * scale
    bullet.changeDynamics(top, -1, localInertiaDiagonal=[I1 * square, I1 * square, I3 * square], linearDamping=0.0)
    for body in (plane, top):
        bullet.changeDynamics(
            body, -1, lateralFriction=np.sqrt(MU), spinningFriction=0.0, rollingFriction=0.0, restitution=0.0
        )
    bullet.changeDynamics(
        top, -1, angularDamping=0.0, maxJointVelocity=1e6, activationState=bullet.ACTIVATION_STATE_DISABLE_SLEEPING
    )
    bullet.resetBaseVelocity(top, angularVelocity=list(SPIN * AXIS))
    angles = []
    for count in np.diff(np.rint(times / step).astype(int), prepend=0):
        for _ in range(count):
            bullet.stepSimulation()
        matrix = bullet.getMatrixFromQuaternion(bullet.getBasePositionAndOrientation(top)[1])
        angles.append(np.arccos(np.clip(matrix[8], -1.0, 1.0)))
    bullet.disconnect(client)
    return np.array(angles)


#: Name -> (package, engine, steps [s]).
ENGINES: dict[str, tuple[str, Engine, tuple[float, ...]]] = {
    "MuJoCo": ("mujoco", mujoco, (1e-4, 5e-5, 2.5e-5, 1e-5)),
    "Drake": ("pydrake", drake, (4e-4, 1e-4, 5e-5)),
    "PyBullet": ("pybullet", pybullet, (1e-4, 2.5e-5, 1e-5, 2.5e-6)),
}


def spent(run: Callable[[], Any]) -> Measured:
    """Call once and measure the CPU time."""
    start_time = time.process_time()
    theta = run()
    return Measured(np.asarray(theta), time.process_time() - start_time)


def ours(times: np.ndarray, tolerance: float) -> np.ndarray:
    """Theta by `simulate` with `SetValuedCoulomb`."""
    scene = tippe.Scene(tippe.Top(*TOP), tippe.Plane(), tippe.SetValuedCoulomb(MU))
    run = tippe.simulate(scene, tippe.Launch(THETA, SPIN), float(times[-1]), times, tolerance=tolerance)
    return np.asarray(run.theta)


def row(program: str, step: str, times: np.ndarray, measured: Measured, exact: np.ndarray) -> dict[str, str]:
    """A row of the table; the error up to 0.5 s is that before a false inversion begins."""
    columns = {f"theta at {times[place]:g} s": f"{measured.theta[place]:.5f}" for place in PRINTED}
    on_its_side = measured.theta > 0.5 * np.pi
    errors = np.abs(measured.theta - exact)
    return {
        "program": program,
        "step": step,
        **columns,
        "on its side at [s]": f"{times[on_its_side.argmax()]:.2f}" if on_its_side.any() else "never",
        "error to 0.5 s": f"{np.max(errors[times <= 0.5]):.1e}",
        "error": f"{np.max(errors):.1e}",
        "CPU s": f"{measured.cpu:.3g}",
    }


def main() -> None:
    """Run, print and write."""
    command = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    command.add_argument("--t1", type=float, default=12.0, help="length of the run [s]")
    command.add_argument("--engines", nargs="+", choices=list(ENGINES), default=list(ENGINES))
    command.add_argument("--out", type=Path, default=Path("engines.csv"))
    options = command.parse_args()
    one_core()
    print(machine())
    times = np.linspace(0.0, options.t1, TIMES)
    exact = ours(times, 1e-12)
    rows = []

    def measured_row(program: str, step: str, run: Callable[[], Any]) -> dict[str, str]:
        return row(program, step, times, spent(run), exact)

    for tolerance in (1e-4, 1e-6, 1e-8, 1e-10):
        ours(times, tolerance)
        rows.append(
            measured_row("SetValuedCoulomb", f"tolerance {tolerance:.0e}", functools.partial(ours, times, tolerance))
        )
        print(rows[-1], flush=True)
    for name in options.engines:
        package, engine, steps = ENGINES[name]
        if not available(package):
            print(f"{name}: {package} not installed, skipped")
            continue
        for step in steps:
            rows.append(measured_row(name, f"{step:g} s", functools.partial(engine, times, step)))
            print(rows[-1], flush=True)
    write_csv(options.out, rows)
    print(table(rows))


if __name__ == "__main__":
    main()
