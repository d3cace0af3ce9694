"""What a release needs: one version everywhere, typed packages, and a law and a body written as CONTRIBUTING.md says."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import pytest
from close import assert_close
from jaxtyping import Array, Float

import tippe
from nonholonomic.validation import Bound, as_number
from tippe.model.body import AbstractBody, AbstractMeridian, ContactGeometry
from tippe.model.friction import AbstractFriction, ContactLoad, Slip, length

ROOT = Path(__file__).parents[1]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_the_version_is_the_same_everywhere():
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {VERSION}\n" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize("package", ["tippe", "stroller", "nonholonomic"])
def test_packages_are_typed(package):
    assert (ROOT / package / "py.typed").exists()


def contributed() -> dict[str, Any]:
    """What the classes in CONTRIBUTING.md define."""
    names = {"AbstractFriction": AbstractFriction, "ContactLoad": ContactLoad, "Slip": Slip, "length": length}
    names |= {"AbstractBody": AbstractBody, "AbstractMeridian": AbstractMeridian, "ContactGeometry": ContactGeometry}
    names |= {"Bound": Bound, "as_number": as_number, "eqx": eqx, "jnp": jnp}
    names |= {"ClassVar": ClassVar, "Iterator": Iterator, "Float": Float, "Array": Array}
    for code in re.findall(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL):
        exec(code, names)
    return names


def test_the_law_that_contributors_read_is_one():
    law = contributed()["Tanh"](0.3, 0.01)
    assert float(law.per_normal_force(Slip(jnp.asarray(1.0), jnp.asarray(0.0))).force[0]) == pytest.approx(-0.3)
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    assert "Tanh(mu=0.3, slip_speed=0.01 m/s)" in str(tippe.Scene(top, friction=law))


def test_the_body_that_contributors_read_is_one():
    """The same forces as by its support function; illegal numbers are refused."""
    kind = contributed()["RoundedDisc"]
    disc = kind(mass=0.05, radius=0.02, belly=0.01, edge=0.003, I1=6e-6, I3=1e-5)
    by_support = tippe.ConvexBody(0.05, lambda c: 0.003 + jnp.sqrt(4e-4 - 3e-4 * c * c), 6e-6, 1e-5)
    state = jnp.array([0.1, -0.2, 0.36, 0.48, 0.8, 2e-4, -3e-4, 1e-3])
    rates = [tippe.Scene(body, friction=tippe.Viscous(0.3)).field(state) for body in (disc, by_support)]
    assert_close(*rates, rtol=1e-12, atol=1e-15)
    with pytest.raises(ValueError, match=r"belly = -0\.01 m"):
        kind(mass=0.05, radius=0.02, belly=-0.01, edge=0.003, I1=6e-6, I3=1e-5)
