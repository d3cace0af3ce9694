"""Ready-made tops and a scene, from a classroom and from the literature, each with its source.

`wooden`, `rutstam`, `cohen` and `leine_glocker` return a `Top`, and `classroom` returns a `Scene`, whose top is its
`.body`. Each has a second name that says so: `wooden_top`, ..., `classroom_scene`.

The tippe tops that Cross filmed (Am. J. Phys. 81 (2013) 280; Phys. Teach. 51 (2013) 144) are missing, because we do not
know their dimensions. Use `Top.turned` for a top whose shape you can measure.

**Example:** a wooden top, spun by hand with `tippe.Launch.degrees(theta=6, rpm=1900)`, climbs onto its stem within 3 s.

```
>>> import tippe
>>> scene = tippe.presets.classroom()
>>> print(scene.friction, scene.contact)
Coulomb(mu=0.3, slip_speed=0.05 m/s) hybrid

```
"""

from nonholonomic.geometry import AbstractSurface, Plane

from .friction import Coulomb
from .model.body import Stem, Top
from .model.scene import Scene


def wooden() -> Top:
    """A classroom top of beech, 4 cm across and 4.7 cm high, drilled around a stem 1 cm thick, of 18 g.

    We designed the shape after the wooden tippe tops of toy shops: a sphere with its cap cut off, hollow around the
    stem. No particular top was measured.

    **Example:**

    >>> tippe.steady.group(tippe.presets.wooden())
    'II'
    """
    shape = {"cut": 0.015, "stem_radius": 0.005, "stem_length": 0.012, "hole_radius": 0.012, "hole_depth": 0.020}
    return Top.turned(radius=0.020, density=700.0, **shape)


def classroom(surface: AbstractSurface = Plane()) -> Scene:  # noqa: B008
    """The wooden top on a table, or on another surface: Coulomb friction, through flights and onto the stem.

    The coefficient 0.3 is usual for wood on wood. The slip speed 0.05 m/s, below which friction falls to zero,
    represents a small contact disc: at a spin of 200 rad/s, the rim of a disc of 0.25 mm moves at this speed. The
    inversion time depends on the slip speed (`docs/tutorials/friction.md`).

    **Example:** in a cylinder.

    >>> print(tippe.presets.classroom(tippe.Cylinder(0.3)).surface)
    Cylinder(radius=0.3 m)
    """
    return Scene(wooden(), surface, Coulomb(0.3, 0.05), contact="hybrid")


def rutstam() -> Top:
    """Rutstam's top: 20 g, R = 2 cm, alpha = 0.3, I3 = 2/5 m R^2, I1 = 131/350 m R^2 (his later papers have this I1).

    Rutstam uses viscous friction, `Viscous(0.3)`. The top has no stem; the papers do not describe its shape. For
    the figures of SIGMA 8 (2012) 019, use that paper's I1 = 235/625 m R^2.

    **Example:**

    >>> tippe.presets.rutstam()
    Top(mass=0.02 kg, radius=0.02 m, offset=0.006 m, I1=2.99429e-06 kg m², I3=3.2e-06 kg m²)
    """
    inertia = 0.02 * 0.02**2
    return Top(0.02, 0.02, 0.006, 131.0 / 350.0 * inertia, 0.4 * inertia)


def cohen() -> Top:
    """Cohen's top: 15 g, R = 2.5 cm, a = 0.5 cm, I1 = I3 = 2/5 m R^2 (Am. J. Phys. 45 (1977) 12).

    Cohen uses Coulomb friction with mu = 0.3. The paper does not state how friction behaves as the slip vanishes.
    Exact Coulomb friction does not turn this top over; with a slip speed of 0.11 m/s, the top follows his Figure 5
    (`examples/cohens_figure.py`). The top has no stem.

    **Example:**

    >>> tippe.presets.cohen()
    Top(mass=0.015 kg, radius=0.025 m, offset=0.005 m, I1=3.75e-06 kg m², I3=3.75e-06 kg m²)
    """
    inertia = 0.4 * 0.015 * 0.025**2
    return Top(0.015, 0.025, 0.005, inertia, inertia)


def leine_glocker() -> Top:
    """Leine and Glocker's top with a stem: 6 g, R = 1.5 cm (Eur. J. Mech. A/Solids 22 (2003) 193).

    Their top starts at theta = 0.1 rad with 180 rad/s and mu = 0.3, under Coulomb-Contensou friction. The paper states
    the moments of inertia, but not the shape of the top.

    **Example:**

    >>> print(tippe.presets.leine_glocker().stem)
    Stem(radius=0.005 m, offset=0.016 m)
    """
    return Top(0.006, 0.015, 0.003, 8e-7, 7e-7, Stem(0.005, 0.016))


#: The tops by their names.
TOPS = {top.__name__: top for top in (wooden, rutstam, cohen, leine_glocker)}

wooden_top, rutstam_top, cohen_top, leine_glocker_top = wooden, rutstam, cohen, leine_glocker
classroom_scene = classroom
