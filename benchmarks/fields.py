"""The lean vector fields in scalar arithmetic, for the peers: the same formulas as `tippe/dynamics.py`, written out.

One text serves NumPy, numba and heyoka: the components are numbers or symbolic expressions, `sqrt` is the caller's.
"""

from typing import NamedTuple


class Numbers(NamedTuple):
    """The numbers of a scene; `slip_speed` 0 is viscous friction, `rho` 0 the plane."""

    mass: float
    radius: float
    offset: float
    I1: float
    I3: float
    mu: float
    gravity: float = 9.81
    slip_speed: float = 0.0
    rho: float = 0.0


def plane(y, p, sqrt):
    """Rate of (u1, u2, e1, e2, e3, L1, L2, L3) on the plane (`tippe.md`, section 2 (i))."""
    u1, u2, e1, e2, e3, L1, L2, L3 = y
    i1 = 1.0 / p.I1
    d1, d2, d3 = (L2 * e3 - L3 * e2) * i1, (L3 * e1 - L1 * e3) * i1, (L1 * e2 - L2 * e1) * i1
    along = (1.0 / p.I3 - i1) * (L1 * e1 + L2 * e2 + L3 * e3)
    s1 = u1 + p.offset * d1 - p.radius * (L2 * i1 + along * e2)
    s2 = u2 + p.offset * d2 + p.radius * (L1 * i1 + along * e1)
    f = -p.mu if p.slip_speed == 0.0 else -p.mu / sqrt(s1 * s1 + s2 * s2 + p.slip_speed * p.slip_speed)
    f1, f2 = f * s1, f * s2
    r1, r2, r3 = p.offset * e1, p.offset * e2, p.offset * e3 - p.radius
    t1, t2, t3 = r2 - r3 * f2, r3 * f1 - r1, r1 * f2 - r2 * f1
    k = p.mass * p.offset * i1
    N = (p.mass * p.gravity - k * (L1 * d2 - L2 * d1)) / (1.0 + k * (t1 * e2 - t2 * e1))
    n = N / p.mass
    return (n * f1, n * f2, d1, d2, d3, N * t1, N * t2, N * t3)


def cylinder(y, p, sqrt):
    """Rate of (u1, u2, e1, e2, e3, L1, L2, L3, sin eta, cos eta) in the cylinder (section 2 (ii))."""
    u1, u2, e1, e2, e3, L1, L2, L3, sn, cn = y
    i1 = 1.0 / p.I1
    d1, d2, d3 = (L2 * e3 - L3 * e2) * i1, (L3 * e1 - L1 * e3) * i1, (L1 * e2 - L2 * e1) * i1
    V1, V2 = u1 + p.offset * d1, u2 + p.offset * d2
    o = V1 / p.rho
    along = (1.0 / p.I3 - i1) * (L1 * e1 + L2 * e2 + L3 * e3)
    s1 = V1 - p.radius * (L2 * i1 + along * e2)
    s2 = V2 + p.radius * (L1 * i1 + along * e1)
    f = -p.mu if p.slip_speed == 0.0 else -p.mu / sqrt(s1 * s1 + s2 * s2 + p.slip_speed * p.slip_speed)
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
