"""What a release needs: one version everywhere, typed packages, and the law of friction that CONTRIBUTING.md shows."""

import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import pytest
from jaxtyping import Array, Float

import tippe
from nonholonomic.validation import Bound, as_number
from tippe.friction import AbstractFriction, ContactLoad, Slip, length

ROOT = Path(__file__).parents[1]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]


def test_the_version_is_the_same_everywhere():
    assert f"\nversion: {VERSION}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## {VERSION}\n" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize("package", ["tippe", "stroller", "nonholonomic"])
def test_packages_are_typed(package):
    assert (ROOT / package / "py.typed").exists()


def test_the_law_that_contributors_read_is_one():
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.DOTALL)
    names = {"AbstractFriction": AbstractFriction, "ContactLoad": ContactLoad, "Slip": Slip, "length": length}
    names |= {"Bound": Bound, "as_number": as_number, "eqx": eqx, "jnp": jnp}
    names |= {"ClassVar": ClassVar, "Iterator": Iterator, "Float": Float, "Array": Array}
    exec(code, names)
    law = names["Tanh"](0.3, 0.01)
    assert float(law.per_normal_force(Slip(jnp.asarray(1.0), jnp.asarray(0.0))).force[0]) == pytest.approx(-0.3)
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    assert "Tanh(mu=0.3, slip_speed=0.01 m/s)" in str(tippe.Scene(top, friction=law))
