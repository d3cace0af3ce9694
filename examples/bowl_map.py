"""Map inversion times over the places of a bowl, smooth and with frozen waves: where does a top turn over fastest?

Run `python examples/bowl_map.py` to print both maps; with matplotlib it also draws them.
"""

from importlib.util import find_spec

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import tippe

PLACES = np.linspace(-0.12, 0.12, 9)


class WavyBowl(eqx.Module):
    """z = (x^2 + y^2) / (2 p) + height sin(k x); you can sweep and differentiate its numbers."""

    p: float
    height: float
    k: float

    def __call__(self, x, y):
        return (x * x + y * y) / (2.0 * self.p) + self.height * jnp.sin(self.k * x)


def times(surface) -> tippe.Table:
    """Inversion times over the places of an arena, for one top, one inclination and one spin."""
    mass, radius = 0.02, 0.02
    inertia = mass * radius**2
    top = tippe.Top(mass, radius, 0.3 * radius, I1=131 / 350 * inertia, I3=0.4 * inertia)
    scene = tippe.Scene(top, surface, tippe.Viscous(0.3))
    axes = {"launch.place[0]": PLACES, "launch.place[1]": PLACES}
    return tippe.inversion_table(scene, theta=0.2, spin=155.0, t1=12.0, axes=axes)


def shown(table: tippe.Table) -> str:
    """The times as text, y upwards; for runs without a time, the first letter of the status."""
    rows = []
    for y in reversed(range(len(PLACES))):
        cells = zip(table.time[:, y], table.status[:, y], strict=True)
        rows.append("  ".join(f"{time:6.3f}" if np.isfinite(time) else f"{word[0]:>6}" for time, word in cells))
    return "\n".join(rows)


def main() -> None:
    for name, surface in {"bowl": tippe.Paraboloid(0.5), "waves": tippe.Graph(WavyBowl(0.5, 0.004, 40.0))}.items():
        table = times(surface)
        print(f"{name}: seconds to 0.95 pi, over x and y from {PLACES[0]} to {PLACES[-1]} m\n{shown(table)}\n")
        if find_spec("matplotlib"):
            table.plot("time").savefig(f"bowl_map_{name}.png", dpi=130)


if __name__ == "__main__":
    main()
