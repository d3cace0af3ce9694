"""Draw the figures of these pages: the meaning of the symbols, and two curves that follow from the formulas."""

from typing import Any

import matplotlib.pyplot as plt
import numpy as np

BODY, FORCE, SLIP, PLAIN = "#c8412b", "#7b4fa3", "#b58300", "#3a3a3e"


def arrow(ax: Any, begin: Any, along: Any, words: str, colour: str, shift: Any = (0.06, 0.0)) -> None:
    """An arrow with its label at the tip."""
    end = np.add(begin, along)
    ax.annotate(
        "", end, begin, arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1.6, "shrinkA": 0, "shrinkB": 0}
    )
    ax.text(*(end + shift), words, color=colour, va="center", fontsize=12)


def arc(ax: Any, centre: Any, radius: float, angles: tuple[float, float], words: str) -> None:
    """The arc of an angle, counted from x, with its label."""
    turn = np.linspace(*angles, 40)
    ax.plot(centre[0] + radius * np.cos(turn), centre[1] + radius * np.sin(turn), color=PLAIN, linewidth=1.0)
    middle = np.mean(angles)
    ax.text(centre[0] + 1.18 * radius * np.cos(middle), centre[1] + 1.18 * radius * np.sin(middle), words, fontsize=12,
            ha="center", va="center")  # fmt: skip


def empty(width: float, height: float) -> tuple[Any, Any]:
    """A figure without axes."""
    figure, ax = plt.subplots(figsize=(width, height), layout="constrained")
    ax.set_aspect("equal")
    ax.set_axis_off()
    plt.close(figure)
    return figure, ax


def top() -> Any:
    """The top in the plane of the normal and its axis."""
    figure, ax = empty(5.2, 4.6)
    theta, offset = 0.6, 0.42
    axis, O = np.array([np.sin(theta), np.cos(theta)]), np.array([0.0, 1.0])  # noqa: E741
    S = O - offset * axis
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    ax.fill(np.cos(turn), 1.0 + np.sin(turn), color="#f4e9d2", zorder=0)
    ax.plot(np.cos(turn), 1.0 + np.sin(turn), color=BODY)
    ax.plot([-1.6, 1.8], [0.0, 0.0], color=PLAIN)
    ax.fill_between([-1.6, 1.8], -0.12, 0.0, color="#dde1e6")
    ax.plot(*np.transpose([O + axis, O + 1.35 * axis]), color=PLAIN, linewidth=5.0, solid_capstyle="round")
    arrow(ax, O, (0.0, 1.45), r"$\mathbf{n}$", PLAIN)
    arrow(ax, O, 1.75 * axis, r"$\mathbf{e}$", BODY)
    arc(ax, O, 0.5, (np.pi / 2.0 - theta, np.pi / 2.0), r"$\theta$")
    ax.plot(*np.transpose([O, S]), color=PLAIN, linestyle="--", linewidth=1.0)
    arrow(ax, S, -S, r"$\mathbf{r}$", BODY, (-0.16, 0.3))
    arrow(ax, (0.0, 0.0), (0.0, 0.62), r"$N\mathbf{n}$", FORCE, (0.05, 0.02))
    arrow(ax, (0.0, 0.0), (-0.75, 0.0), r"$N\mathbf{f}$", FORCE, (-0.05, 0.13))
    arrow(ax, (0.0, 0.0), (0.95, 0.0), r"$\mathbf{v}_s$", SLIP, (0.02, 0.13))
    arrow(ax, S, (0.0, -0.5), r"$m g$", FORCE, (-0.33, 0.1))
    for point, words, shift in ((O, "$O$", (0.08, -0.06)), (S, "$S$", (-0.2, 0.05))):
        ax.plot(*point, "o", color=PLAIN, markersize=5)
        ax.text(*(point + shift), words, fontsize=12)
    ax.text(*(0.5 * (O + S) + (0.06, -0.07)), "$a$", fontsize=12)
    ax.plot([0.0, -0.8], [1.0, 1.6], color=PLAIN, linewidth=0.8)
    ax.text(-0.5, 1.24, "$R$", fontsize=12)
    ax.set(xlim=(-1.65, 1.85), ylim=(-0.2, 2.65))
    return figure


def turned() -> Any:
    """The section of a top turned from one material, with the lengths that `Top.turned` takes."""
    figure, ax = empty(6.4, 5.4)
    R, cut, stem, length, hole, depth = 1.0, 0.75, 0.25, 0.6, 0.6, 1.0
    rim, tip = np.sqrt(R**2 - cut**2), cut + length - stem
    turn = np.linspace(np.arccos(cut), 2.0 * np.pi - np.arccos(cut), 200)
    cap = np.linspace(0.0, np.pi, 60)
    half = [(rim, cut), (hole, cut), (hole, cut - depth), (stem, cut - depth), (stem, tip)]
    outline = [*half, *zip(stem * np.cos(cap), tip + stem * np.sin(cap), strict=True)]
    outline += [(-x, y) for x, y in reversed(half)] + list(zip(-np.sin(turn[::-1]), np.cos(turn), strict=True))[::-1]
    ax.fill(*np.transpose(outline), facecolor="#f4e9d2", edgecolor=BODY, linewidth=1.4)
    ax.plot(np.sin(turn), np.cos(turn), color=BODY, linewidth=1.4)
    ax.plot([0.0, 0.0], [-1.15, tip + stem + 0.2], color=PLAIN, linewidth=0.7, linestyle="-.")
    ax.plot(0.0, 0.0, "o", color=PLAIN, markersize=4)
    ax.text(-0.05, 0.1, "$O$", fontsize=12, ha="right")
    for height in (0.0, cut):
        ax.plot([0.0 if height == 0.0 else rim, 1.75], [height] * 2, color="0.7", linewidth=0.7)
    ax.plot([0.0, 1.75], [tip + stem] * 2, color="0.7", linewidth=0.7)
    ax.plot([-1.75, -stem], [cut - depth] * 2, color="0.7", linewidth=0.7)
    ax.plot([-1.75, -rim], [cut] * 2, color="0.7", linewidth=0.7)
    spans = [
        ((1.15, 0.0), (1.15, cut), "cut", (1.2, 0.35)),
        ((1.65, cut), (1.65, tip + stem), "stem_length", (1.7, 1.02)),
    ]
    spans += [((-1.3, cut), (-1.3, cut - depth), "hole_depth", (-1.35, 0.2))]
    spans += [
        ((0.0, 0.95), (stem, 0.95), "stem_radius", (0.32, 0.93)),
        ((0.0, -0.12), (hole, -0.12), "hole_radius", (0.05, -0.37)),
    ]
    spans += [((0.0, 0.0), (-np.sin(2.2), np.cos(2.2)), "radius", (-0.6, -0.62))]
    for begin, end, words, place in spans:
        ax.annotate("", end, begin, arrowprops={"arrowstyle": "<|-|>", "color": PLAIN, "shrinkA": 0, "shrinkB": 0})
        ax.text(*place, words, fontsize=11, family="monospace", va="center", ha="right" if place[0] < -1.0 else "left")
    ax.set(xlim=(-2.3, 2.75), ylim=(-1.2, 1.6))
    return figure


def torque() -> Any:
    """Slip, friction and torque of a tilted, fast top: seen along the slip, and from above."""
    figure, (side, above) = plt.subplots(1, 2, figsize=(9.0, 4.4), layout="constrained")
    theta, offset = 0.6, 0.42
    axis, O = np.array([np.sin(theta), np.cos(theta)]), np.array([0.0, 1.0])  # noqa: E741
    S, turn = O - offset * axis, np.linspace(0.0, 2.0 * np.pi, 200)
    for ax in (side, above):
        ax.set_aspect("equal")
        ax.set_axis_off()
    side.fill(np.cos(turn), 1.0 + np.sin(turn), color="#f4e9d2", zorder=0)
    side.plot(np.cos(turn), 1.0 + np.sin(turn), color=BODY)
    side.plot([-1.6, 1.8], [0.0, 0.0], color=PLAIN)
    side.fill_between([-1.6, 1.8], -0.12, 0.0, color="#dde1e6")
    side.plot(*np.transpose([O + axis, O + 1.35 * axis]), color=PLAIN, linewidth=5.0, solid_capstyle="round")
    arrow(side, O, 1.75 * axis, r"$\mathbf{e}$", BODY)
    arrow(side, S, (0.0, 1.6), r"$\mathbf{L}$", "#2a6f97", (-0.2, 0.0))
    arrow(side, S, -S, r"$\mathbf{r}$", BODY, (-0.24, 0.32))
    for point, words, shift in ((O, "$O$", (0.08, -0.06)), (S, "$S$", (-0.22, 0.05))):
        side.plot(*point, "o", color=PLAIN, markersize=5)
        side.text(*(point + shift), words, fontsize=12)
    for x, mark, words, colour in ((0.3, "x", r"$\mathbf{v}_s$", SLIP), (0.75, ".", r"$\mathbf{F}$", FORCE)):
        side.plot(x, -0.4, "o", color=colour, markersize=13, fillstyle="none")
        side.plot(x, -0.4, mark, color=colour, markersize=7)
        side.text(x + 0.12, -0.4, words, color=colour, fontsize=12, va="center")
    side.text(0.0, -0.4, "contact:", fontsize=10, ha="right", va="center")
    side.set(xlim=(-1.65, 1.85), ylim=(-0.6, 2.65), title="along the slip")
    above.plot(np.cos(turn), np.sin(turn), color=BODY)
    above.fill(np.cos(turn), np.sin(turn), color="#f4e9d2", zorder=0)
    place = np.array([-offset * np.sin(theta), 0.0])
    above.plot([0.0, np.sin(theta)], [0.0, 0.0], color=PLAIN, linewidth=1.0, linestyle="--")
    arrow(above, (np.sin(theta), 0.0), (0.75, 0.0), r"$\mathbf{e}$", BODY)
    arrow(above, (0.0, 0.0), (0.0, 0.8), r"$\mathbf{v}_s$", SLIP)
    arrow(above, (0.0, 0.0), (0.0, -0.65), r"$\mathbf{F}$", FORCE)
    arrow(above, place, (-0.95, 0.0), r"$\mathbf{r}\times\mathbf{F}$", FORCE, (-0.3, 0.2))
    above.plot(*place, "o", color=PLAIN, markersize=5)
    above.text(place[0] - 0.06, place[1] - 0.2, "$S$", fontsize=12)
    above.plot(0.0, 0.0, "o", color=FORCE, markersize=5)
    spin = np.linspace(0.3, 1.25, 40)
    above.annotate(
        "", 1.15 * np.array([np.cos(spin[-1]), np.sin(spin[-1])]), 1.15 * np.array([np.cos(spin[-2]), np.sin(spin[-2])]),
        arrowprops={"arrowstyle": "-|>", "color": PLAIN},
    )  # fmt: skip
    above.plot(1.15 * np.cos(spin), 1.15 * np.sin(spin), color=PLAIN, linewidth=1.2)
    above.text(1.08, 0.85, "spin", fontsize=10)
    above.set(xlim=(-1.75, 1.75), ylim=(-1.4, 1.6), title="from above")
    plt.close(figure)
    return figure


def angles() -> Any:
    """The angles of a launch: eta in a cylinder, theta from the normal to the axis, azimuth in the tangent plane."""
    figure, (section, tangent) = plt.subplots(1, 2, figsize=(9.0, 4.4), layout="constrained", width_ratios=(1.3, 1.0))
    for ax in (section, tangent):
        ax.set_aspect("equal")
        ax.set_axis_off()
    eta, theta, radius, body = 0.6, 0.55, 3.0, 0.6
    wall = np.linspace(-0.35 * np.pi, 0.45 * np.pi, 200)
    section.plot(radius * np.sin(wall), -radius * np.cos(wall), color=PLAIN, linewidth=2.0)
    n, t1 = np.array([-np.sin(eta), np.cos(eta)]), np.array([np.cos(eta), np.sin(eta)])
    centre = -(radius - body) * n
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    section.fill(centre[0] + body * np.cos(turn), centre[1] + body * np.sin(turn), color="#f4e9d2", zorder=0)
    section.plot(centre[0] + body * np.cos(turn), centre[1] + body * np.sin(turn), color=BODY)
    axis = np.cos(theta) * n + np.sin(theta) * t1
    arrow(section, centre, 1.6 * n, r"$\mathbf{n}$", PLAIN, (-0.12, 0.16))
    arrow(section, centre, 1.25 * t1, r"$\mathbf{t}_1$", PLAIN, (0.05, -0.1))
    arrow(section, centre, 1.5 * axis, r"$\mathbf{e}$", BODY, (0.06, 0.05))
    angle = np.arctan2(n[1], n[0])
    arc(section, centre, 0.85, (angle - theta, angle), r"$\theta$")
    section.plot([0.0, 0.0], [0.0, -radius], color="0.6", linewidth=0.9)
    section.plot(*np.transpose([(0.0, 0.0), -radius * n]), color="0.6", linewidth=0.9)
    arc(section, (0.0, 0.0), 1.1, (-np.pi / 2.0, -np.pi / 2.0 + eta), r"$\eta$")
    section.plot(0.0, 0.0, "o", color=PLAIN, markersize=4)
    section.text(0.08, 0.1, "axis of the cylinder, $y$", fontsize=10)
    arrow(section, (-2.3, -0.2), (0.0, 0.7), "$z$", PLAIN)
    arrow(section, (-2.3, -0.2), (0.7, 0.0), "$x$", PLAIN)
    section.set(xlim=(-2.6, 3.1), ylim=(-3.2, 1.0), title="a top in a cylinder")
    azimuth = 0.9
    arrow(tangent, (0.0, 0.0), (1.6, 0.0), r"$\mathbf{t}_1$", PLAIN)
    arrow(tangent, (0.0, 0.0), (0.0, 1.6), r"$\mathbf{t}_2$", PLAIN)
    arrow(tangent, (0.0, 0.0), 1.3 * np.array([np.cos(azimuth), np.sin(azimuth)]), r"$\mathbf{e}$", BODY)
    arc(tangent, (0.0, 0.0), 0.6, (0.0, azimuth), r"azimuth $\phi$")
    tangent.plot(0.0, 0.0, "o", color=PLAIN, markersize=5)
    tangent.text(-0.15, -0.2, r"$\mathbf{n}$ points at you", fontsize=10)
    tangent.set(xlim=(-0.4, 2.0), ylim=(-0.4, 1.9), title="the tangent plane")
    plt.close(figure)
    return figure


def vehicle() -> Any:
    """The stroller from above, and its centre of rotation."""
    figure, ax = empty(6.4, 4.6)
    psi, phi, half = 0.25, 0.5, 0.35
    along, left = np.array([np.cos(psi), np.sin(psi)]), np.array([-np.sin(psi), np.cos(psi)])
    forward = np.array([np.cos(psi + phi), np.sin(psi + phi)])
    rear, front = np.zeros(2), 1.3 * along
    centre = 1.3 / np.tan(phi) * left
    for begin, end in ((rear, centre), (front, centre)):
        ax.plot(*np.transpose([begin, end]), color="0.7", linestyle="--", linewidth=1.0)
    ax.plot(*np.transpose([rear, front]), color=BODY, linewidth=2.5)
    ax.plot(*np.transpose([rear - half * left, rear + half * left]), color=BODY, linewidth=2.5)
    wheels = ((rear - half * left, along), (rear + half * left, along), (front, forward))
    for at, heading in wheels:
        ax.plot(*np.transpose([at - 0.16 * heading, at + 0.16 * heading]), color=PLAIN, linewidth=7.0)
    arrow(ax, rear, -0.02 * left + 0.85 * along, r"$v\,\mathbf{e}$", FORCE, 0.13 * left - 0.1 * along)
    arrow(ax, front, 0.7 * forward, "$w$", FORCE)
    ax.plot(*np.transpose([front, front + 0.8 * along]), color="0.6", linewidth=0.8)
    arc(ax, front, 0.5, (psi, psi + phi), r"$\varphi$")
    ax.plot([0.0, 0.8], [0.0, 0.0], color="0.6", linewidth=0.8)
    ax.text(0.85, -0.03, "$x$", fontsize=12)
    arc(ax, rear, 0.55, (0.0, psi), r"$\psi$")
    ax.text(*(0.72 * front - 0.13 * left), "$l$", fontsize=12)
    ax.plot(*centre, "o", color=PLAIN, markersize=5)
    ax.text(centre[0] + 0.08, centre[1], r"turns about this point at $\Omega=v\,\tan\varphi/l$", fontsize=11)
    ax.set(xlim=(-0.8, 2.6), ylim=(-0.5, 2.5))
    return figure


def groups() -> Any:
    """The least energy at a given Jellett constant, for a top of each group and increasing constants."""
    figure, axes = plt.subplots(1, 3, figsize=(10.0, 3.2), layout="constrained")
    theta, alpha = np.linspace(0.0, np.pi, 400), 0.3
    for ax, (name, gamma) in zip(axes, {"I": 0.6, "II": 1.0, "III": 1.5}.items(), strict=True):
        # In units of m g R, with I3 = 2/5 m R^2.
        G = 0.4 * (gamma * np.sin(theta) ** 2 + (np.cos(theta) - alpha) ** 2)
        for number, jellett in enumerate((0.3, 0.6, 0.9, 1.2)):
            energy = jellett**2 / (2.0 * np.maximum(G, 1e-9)) + 1.0 - alpha * np.cos(theta)
            ax.plot(theta, energy, color=plt.get_cmap("viridis")(number / 3.5), linewidth=1.2)
            beside = np.pad(energy, 1, constant_values=np.inf)
            least = (energy < beside[:-2]) & (energy < beside[2:])
            ax.plot(theta[least], energy[least], "o", color=BODY, markersize=5)
        ax.set(title=rf"{name}: $\gamma$ = {gamma}", xlabel=r"$\theta$", ylim=(0.6, 6.0))
        ax.set_xticks([0.0, np.pi / 2.0, np.pi], ["0", "π/2", "π"])
    axes[0].set_ylabel(r"$E_\lambda / m g R$")
    plt.close(figure)
    return figure


def lanes() -> Any:
    """Four lanes over time: every run has its own steps, and a free lane takes the next cell."""
    figure, ax = plt.subplots(figsize=(8.0, 2.2), layout="constrained")
    random, free, cell = np.random.default_rng(3), np.zeros(4, int), 0
    while free.min() < 30:
        lane, length = int(np.argmin(free)), int(random.integers(5, 14))
        at, colour = free[lane], plt.get_cmap("tab10")(cell % 10)
        ax.barh(lane, [0.86] * length, left=at + np.arange(length), height=0.7, align="edge", color=colour)
        ax.text(at + 0.43, lane + 0.35, f"{cell}", color="white", ha="center", va="center", fontsize=8)
        free[lane], cell = at + length, cell + 1
    ax.set(xlabel="steps, made by all lanes at once", ylabel="lane", xlim=(0, 30), yticks=[])
    plt.close(figure)
    return figure


if __name__ == "__main__":
    for draw in (top, torque, angles, vehicle, groups, lanes):
        draw().savefig(f"{draw.__name__}.png", dpi=100)
