"""The reference scenes of a sphere on a level plane by MuJoCo, for `check.py`: `pip install mujoco`, about 20 s per
scene.

MuJoCo's contact is soft, and its friction is Coulomb's. MuJoCo computes exact Coulomb friction itself. Other friction
laws are applied as a force to a frictionless contact, with the normal force of the previous step.
"""

from typing import Any

import mujoco
import numpy as np

STEP = 2e-5
#: Stiffness [1/s^2] and damping [1/s] of the contact.
CONTACT = (-1e7, -6.4e3)
MODEL = """<mujoco><option timestep="{step}" gravity="0 0 -{gravity}" integrator="RK4" cone="elliptic" impratio="100"/>
<default><geom condim="{condim}" friction="{mu} 0 0" solref="{solref}" solimp="0.999 0.9999 1e-5"/></default>
<worldbody><geom type="plane" size="9 9 1"/><body name="top"><freejoint/><geom type="sphere" size="{radius}"/>
<inertial pos="0 0 -{offset}" mass="{mass}" diaginertia="{I1} {I1} {I3}"/></body></worldbody></mujoco>"""
INVERTED = np.cos(0.95 * np.pi)


def simulate(scene: dict[str, Any]) -> dict[str, Any] | None:
    if scene["vehicle"] != "top" or scene["arena"] != {"shape": "plane", "tilt": 0.0} or "polar" in scene["body"]:
        return None
    friction, body, start = scene["friction"], scene["body"], {k: np.array(v) for k, v in scene["start"].items()}
    exact = friction["law"] == "set-valued coulomb"
    options = {"step": STEP, "gravity": scene["gravity"], "condim": 3 if exact else 1, "mu": friction["mu"]}
    model = mujoco.MjModel.from_xml_string(MODEL.format(**options, **body, solref=f"{CONTACT[0]} {CONTACT[1]}"))
    data = mujoco.MjData(model)
    e, w = start["axis"], start["angular_velocity"]
    # The shortest rotation that takes z to the axis.
    quaternion = np.array((1.0 + e[2], -e[1], e[0], 0.0))
    data.qpos[:] = np.concatenate([start["position"] + body["offset"] * e, quaternion / np.linalg.norm(quaternion)])
    mujoco.mj_forward(model, data)
    data.qvel[:3] = start["velocity"] + body["offset"] * np.cross(w, e)
    data.qvel[3:] = data.xmat[1].reshape(3, 3).T @ w
    states = {name: [] for name in ("position", "velocity", "axis", "angular_velocity")}
    events, force, times = [], np.zeros(6), list(scene["states"]["times"])
    slip_speed = friction.get("slip_speed")
    end = 1.2 * max(event["time"] for event in scene["events"] or [{"time": 0.0}])
    counted = scene["outcome"] in ("inverted", "contact_lost")
    while times or (counted and not events and data.time < end):
        turned = data.xmat[1].reshape(3, 3)
        e, w = turned[:, 2], turned @ data.qvel[3:]
        if times and data.time > times[0] - 0.5 * STEP:
            velocity = data.qvel[:3] - body["offset"] * np.cross(w, e)
            for name, value in zip(states, (data.xipos[1], velocity, e, w), strict=True):
                states[name].append(value.copy())
            times.pop(0)
        touching = data.ncon > 0
        if touching:
            mujoco.mj_contactForce(model, data, 0, force)
        elif scene["outcome"] == "contact_lost":
            events = events or [data.time]
        if scene["outcome"] == "inverted" and e[2] < INVERTED:
            events = events or [data.time]
        if not exact:
            slip = data.qvel[:2] + body["radius"] * np.array((-w[1], w[0]))
            size = np.sqrt(slip @ slip + slip_speed**2) if slip_speed else 1.0
            push = np.append(-friction["mu"] * force[0] * touching / size * slip, 0.0)
            arm = np.array((0.0, 0.0, -body["radius"])) + data.qpos[:3] - data.xipos[1]
            data.xfrc_applied[1] = np.concatenate([push, np.cross(arm, push)])
        mujoco.mj_step(model, data)
    return {"states": states} | ({"events": events} if counted else {})
