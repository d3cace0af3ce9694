"""Which launch to measure next: the most informative one for friction and offset together (D-optimal design)."""

import numpy as np

import tippe

ANGLE, ERROR = 0.5 * np.pi, 0.02
THETA, SPIN = [0.005, 0.01, 0.02, 0.04], [70.0, 80.0, 90.0, 100.0, 120.0, 140.0, 160.0]
NAMES = {"mu": 0.3, "offset": 0.0035}
#: The launches measured so far: one angle, the two fastest spins.
DONE = [(1, 5), (1, 6)]


def scene() -> tippe.Scene:
    inertia = 0.02 * 0.02**2
    top = tippe.Top(mass=0.02, radius=0.02, offset=NAMES["offset"], I1=131 / 350 * inertia, I3=0.4 * inertia)
    return tippe.Scene(top, friction=tippe.Viscous(NAMES["mu"]))


def errors(information: np.ndarray) -> str:
    """The relative standard errors from an information matrix."""
    deviations = np.sqrt(np.diag(np.linalg.inv(information)))
    return ", ".join(f"{name} to {100.0 * error:.2g} %" for name, error in zip(NAMES, deviations, strict=True))


def main() -> None:
    table = tippe.inversion_table(
        scene(), theta=THETA, spin=SPIN, t1=60.0, angle=ANGLE, tolerance=1e-7, sensitivities=list(NAMES)
    )
    # Slopes of the times with respect to relative changes, in units of the error: a launch adds their outer product.
    slopes = [value * np.asarray(table.variables[f"time_by_{name}"]) / ERROR for name, value in NAMES.items()]
    slopes = np.stack(slopes, axis=-1)
    information = sum(np.outer(slopes[launch], slopes[launch]) for launch in DONE)
    print(f"{len(DONE)} launches of theta {THETA[1]} fix {errors(information)}")
    for _ in range(3):
        new_information = information + slopes[..., :, None] * slopes[..., None, :]
        gain = np.linalg.slogdet(new_information)[1] - np.linalg.slogdet(information)[1]
        index = np.unravel_index(np.argmax(gain), gain.shape)
        information = new_information[index]
        print(f"next: theta {THETA[index[0]]}, spin {SPIN[index[1]]:.0f} rad/s: then {errors(information)}")
    repeated = sum(np.outer(slopes[launch], slopes[launch]) for launch in (*DONE, *DONE, DONE[0]))
    print(f"measuring the first ones again instead: {errors(repeated)}")
    print("A time is a staircase in the parameters: check that slopes do not depend on small changes of the launch.")


if __name__ == "__main__":
    main()
