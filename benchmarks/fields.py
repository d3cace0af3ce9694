"""The vector fields in scalar arithmetic, for other programs.

They are the formulas of `tippe/model/dynamics.py` and `stroller/model/scene.py`. The same text serves NumPy, numba,
JAX and heyoka: the components are numbers, arrays or symbolic expressions, and the caller passes the functions.
`scenes.misprint` compares each field with the scene's own.
"""

from typing import Any, NamedTuple


class Functions(NamedTuple):
    """The functions that a field may call."""

    sqrt: Any


class Top(NamedTuple):
    """The numbers of a top's scene; `slip_speed` 0 is viscous friction, `rho` 0 the plane, `turns` the fraction of L3 / I1 at
    which the frame turns there."""

    mass: float
    radius: float
    offset: float
    I1: float
    I3: float
    mu: float
    gravity: float = 9.81
    slip_speed: float = 0.0
    rho: float = 0.0
    turns: float = 0.0


class Ride(NamedTuple):
    """The numbers of a stroller inside a spheroid: body, gravity, semi-axes, and the four dampings of `Damping`."""

    mass: float
    wheelbase: float
    inertia: float
    steering_inertia: float
    steering_spring: float
    gravity: float
    equatorial: float
    polar: float
    rolling: float
    front: float
    scrub: float
    steering: float


def plane(y, p, functions):
    """Rate of (u1, u2, e1, e2, e3, L1, L2, L3) on the plane (`tippe.md`, section 2 (i))."""
    u1, u2, e1, e2, e3, L1, L2, L3 = y
    i1 = 1.0 / p.I1
    d1, d2, d3 = (L2 * e3 - L3 * e2) * i1, (L3 * e1 - L1 * e3) * i1, (L1 * e2 - L2 * e1) * i1
    axial_rate = (1.0 / p.I3 - i1) * (L1 * e1 + L2 * e2 + L3 * e3)
    s1 = u1 + p.offset * d1 - p.radius * (L2 * i1 + axial_rate * e2)
    s2 = u2 + p.offset * d2 + p.radius * (L1 * i1 + axial_rate * e1)
    f = -p.mu if p.slip_speed == 0.0 else -p.mu / functions.sqrt(s1 * s1 + s2 * s2 + p.slip_speed * p.slip_speed)
    f1, f2 = f * s1, f * s2
    r1, r2, r3 = p.offset * e1, p.offset * e2, p.offset * e3 - p.radius
    t1, t2, t3 = r2 - r3 * f2, r3 * f1 - r1, r1 * f2 - r2 * f1
    k = p.mass * p.offset * i1
    N = (p.mass * p.gravity - k * (L1 * d2 - L2 * d1)) / (1.0 + k * (t1 * e2 - t2 * e1))
    n = N / p.mass
    rate = (n * f1, n * f2, d1, d2, d3, N * t1, N * t2, N * t3)
    if p.turns == 0.0:
        return rate
    turn = p.turns * i1 * L3
    a1, a2, d1, d2, d3, b1, b2, b3 = rate
    return (a1 + turn * u2, a2 - turn * u1, d1 + turn * e2, d2 - turn * e1, d3, b1 + turn * L2, b2 - turn * L1, b3)


def cylinder(y, p, functions):
    """Rate of (u1, u2, e1, e2, e3, L1, L2, L3, sin eta, cos eta) in the cylinder (section 2 (ii))."""
    u1, u2, e1, e2, e3, L1, L2, L3, sn, cn = y
    i1 = 1.0 / p.I1
    d1, d2, d3 = (L2 * e3 - L3 * e2) * i1, (L3 * e1 - L1 * e3) * i1, (L1 * e2 - L2 * e1) * i1
    V1, V2 = u1 + p.offset * d1, u2 + p.offset * d2
    o = V1 / p.rho
    axial_rate = (1.0 / p.I3 - i1) * (L1 * e1 + L2 * e2 + L3 * e3)
    s1 = V1 - p.radius * (L2 * i1 + axial_rate * e2)
    s2 = V2 + p.radius * (L1 * i1 + axial_rate * e1)
    f = -p.mu if p.slip_speed == 0.0 else -p.mu / functions.sqrt(s1 * s1 + s2 * s2 + p.slip_speed * p.slip_speed)
    f1, f2 = f * s1, f * s2
    r1, r2, r3 = p.offset * e1, p.offset * e2, p.offset * e3 - p.radius
    t1, t2, t3 = r2 - r3 * f2, r3 * f1 - r1, r1 * f2 - r2 * f1
    k = p.mass * p.offset * i1
    N = (p.mass * (V1 * o + p.gravity * cn) - k * (L1 * d2 - L2 * d1)) / (1.0 + k * (t1 * e2 - t2 * e1))
    n = N / p.mass
    return (
        n * f1 - p.gravity * sn - o * p.offset * d3,
        n * f2,
        d1 + o * e3,
        d2,
        d3 - o * e1,
        N * t1 + o * L3,
        N * t2,
        N * t3 - o * L1,
        o * cn,
        -o * sn,
    )


def spheroid(y, p, functions):
    """Rate of (r1, r2, r3, e1, e2, e3, phi, P, phi', sin phi, cos phi, work) inside a spheroid (`stroller.md`, section 5)."""
    r1, r2, r3, e1, e2, e3, phi, P, turning, sine, cosine, _ = y
    radial_weight, axial_rate = 1.0 / (p.equatorial * p.equatorial), 1.0 / (p.polar * p.polar)
    g1, g2, g3 = radial_weight * r1, radial_weight * r2, axial_rate * r3
    unit = 1.0 / functions.sqrt(g1 * g1 + g2 * g2 + g3 * g3)
    n1, n2, n3 = unit * g1, unit * g2, unit * g3
    normal_part = e1 * n1 + e2 * n2 + e3 * n3
    d1, d2, d3 = e1 - normal_part * n1, e2 - normal_part * n2, e3 - normal_part * n3
    d = 1.0 / functions.sqrt(d1 * d1 + d2 * d2 + d3 * d3)
    arm = sine / p.wheelbase
    gauge = 1.0 / functions.sqrt(p.mass * cosine * cosine + p.inertia * arm * arm)
    w = P * gauge
    v, yaw = w * cosine, w * arm
    v1, v2, v3 = v * d * d1, v * d * d2, v * d * d3
    c1, c2, c3 = radial_weight * v1, radial_weight * v2, axial_rate * v3
    tipping = n1 * c1 + n2 * c2 + n3 * c3
    m1, m2, m3 = unit * (c1 - tipping * n1), unit * (c2 - tipping * n2), unit * (c3 - tipping * n3)
    # The driver's left is to the right of the outward normal: inside, the frame turns at -yaw about it.
    w1, w2, w3 = n2 * m3 - n3 * m2 - yaw * n1, n3 * m1 - n1 * m3 - yaw * n2, n1 * m2 - n2 * m1 - yaw * n3
    rear, front, scrub, steering = -p.rolling * v, -p.front * w, -p.scrub * yaw, -p.steering * turning
    return (
        v1,
        v2,
        v3,
        w2 * e3 - w3 * e2,
        w3 * e1 - w1 * e3,
        w1 * e2 - w2 * e1,
        turning,
        gauge * (cosine * rear + front + arm * scrub - p.mass * p.gravity * cosine * d * d3),
        (steering - p.steering_spring * phi) / p.steering_inertia,
        cosine * turning,
        -sine * turning,
        rear * v + front * w + scrub * yaw + steering * turning,
    )
