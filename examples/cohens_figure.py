"""Determine friction from four angles read off a printed figure: Cohen's Figure 5 (Am. J. Phys. 45 (1977) 12) as data.

According to the paper, the figure shows Coulomb friction with mu = 0.3. With exact Coulomb friction this top does not
invert: slip stops after 0.03 s. So the figure belongs to a law that is smooth at low slip, here mu N v / sqrt(v^2 +
v0^2), with unknown v0.
"""

import warnings

import tippe
from nonholonomic.identification import Identification

TIMES, THETA, READING = [0.5, 1.0, 1.5, 2.0], [0.40, 1.66, 2.74, 3.04], 0.025


def scene(mu: float, slip_speed: float) -> tippe.Scene:
    mass, radius = 0.015, 0.025
    inertia = 0.4 * mass * radius**2
    return tippe.Scene(tippe.Top(mass, radius, 0.005, inertia, inertia), friction=tippe.Coulomb(mu, slip_speed))


def shown(fit: Identification, title: str) -> None:
    print(title)
    for name in fit.estimates:
        low, high = fit.interval(name)
        print(f"  {name} = {fit.estimates[name]:.3g}, 95 %: {low:.3g} to {high:.3g}")
    print(f"  probability of such residuals {fit.verdict.p_value:.2g}")


def main() -> None:
    launch = tippe.Launch(theta=0.1, spin=100.0)
    figure = tippe.Recording(launch, TIMES, THETA, [READING * theta for theta in THETA])
    shown(tippe.identify(scene(0.3, 0.08), figure, {"slip_speed": 0.08}), "the slip speed, if mu is 0.3 as printed:")
    with warnings.catch_warnings():
        # The example shows how well the data determine both.
        warnings.simplefilter("ignore", tippe.FitWarning)
        fit = tippe.identify(scene(0.3, 0.08), figure, {"mu": 0.3, "slip_speed": 0.08})
    shown(fit, "both:")
    for value, words in zip(fit.identifiability.singular_values, fit.identifiability.words, strict=True):
        print(f"  known to {100.0 / value:.2g} %: {words}")
    print("So the figure fixes mu / sqrt(v0) to 1 %, but mu and v0 along that line to 10 % only.")


if __name__ == "__main__":
    main()
