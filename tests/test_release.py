"""What a release needs: one version, files for citations, typed packages, and a law and a body that users add."""

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import pytest
import yaml
from close import assert_close
from jaxtyping import Array, Float

import nonholonomic
import stroller
import tippe
from nonholonomic.sweeps.grid import versions
from nonholonomic.validation import Bound, as_number
from tippe.friction import Slip
from tippe.model.body import AbstractBody, AbstractMeridian, ContactGeometry

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_version_is_set_in_one_place():
    """The package's metadata take it from `nonholonomic/__init__.py`; the files for citations and changes repeat it."""
    assert PROJECT["dynamic"] == ["version"]
    assert nonholonomic.__version__ == tippe.__version__ == stroller.__version__ == versions()["nonholonomic"]
    assert f"\nversion: {nonholonomic.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    first = re.search(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert first.group(1) == nonholonomic.__version__


def test_citations_name_the_same_authors_and_licence():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    deposit = json.loads((ROOT / ".zenodo.json").read_text())
    paper = yaml.safe_load((ROOT / "paper" / "paper.md").read_text().split("---")[1])
    names = [author["name"] for author in citation["authors"]]
    assert (
        names == [author["name"] for author in deposit["creators"]] == [author["name"] for author in paper["authors"]]
    )
    assert citation["title"] == deposit["title"]
    assert citation["license"] == deposit["license"] == PROJECT["license"]


def test_every_python_that_is_named_is_tested():
    checks = yaml.safe_load((ROOT / ".github" / "workflows" / "check.yml").read_text())
    versions = checks["jobs"]["run"]["strategy"]["matrix"]["python"]
    matches = [re.fullmatch(r"Programming Language :: Python :: (3\.\d+)", line) for line in PROJECT["classifiers"]]
    assert versions == [version.group(1) for version in matches if version]
    assert PROJECT["requires-python"] == f">={versions[0]}"


def test_the_paper_cites_what_its_bibliography_has():
    text, bibliography = ((ROOT / "paper" / name).read_text() for name in ("paper.md", "paper.bib"))
    assert set(re.findall(r"@(\w+)(?=[\];,])", text)) == set(re.findall(r"^@\w+\{(\w+),", bibliography, re.MULTILINE))
    figures = re.findall(r"\]\(([^)]+\.png)\)", text)
    assert len(figures) == 2
    assert all((ROOT / "paper" / figure).exists() for figure in figures)
    assert 750 <= len(text.split()) <= 1500


@pytest.mark.parametrize("package", ["tippe", "stroller", "nonholonomic"])
def test_packages_are_typed(package):
    assert (ROOT / package / "py.typed").exists()


LAW = re.compile(r"```\{code-cell\}\n([^`]*class Tanh.*?)\n\n\nscene =", re.DOTALL)


def test_the_law_of_the_tutorial_has_its_force_and_units():
    names = {"tippe": tippe}
    exec(LAW.search((ROOT / "docs" / "tutorials" / "friction.md").read_text()).group(1), names)
    law = names["Tanh"](0.3, 0.01)
    assert float(law.per_normal_force(Slip(jnp.asarray(1.0), jnp.asarray(0.0))).force[0]) == pytest.approx(-0.3)
    top = tippe.Top(mass=0.02, radius=0.02, offset=0.006, I1=2.994e-6, I3=3.2e-6)
    assert "Tanh(mu=0.3, slip_speed=0.01 m/s)" in str(tippe.Scene(top, friction=law))


class RoundedDisc(AbstractBody):
    """A disc with a belly and a round edge: H = edge + h with h^2 = radius^2 - (radius^2 - belly^2) c^2."""

    units: ClassVar[dict[str, str]] = {
        "mass": "kg",
        "radius": "m",
        "belly": "m",
        "edge": "m",
        "I1": "kg m2",
        "I3": "kg m2",
    }

    mass: Float[Array, "..."] = eqx.field(converter=as_number)
    radius: Float[Array, "..."] = eqx.field(converter=as_number)
    belly: Float[Array, "..."] = eqx.field(converter=as_number)
    edge: Float[Array, "..."] = eqx.field(converter=as_number)
    I1: Float[Array, "..."] = eqx.field(converter=as_number)
    I3: Float[Array, "..."] = eqx.field(converter=as_number)

    def bounds(self) -> Iterator[Bound]:
        yield from super().bounds()
        for name in ("radius", "belly", "edge"):
            yield Bound(getattr(self, name), name, above=0.0)

    @property
    def meridian(self) -> AbstractMeridian:
        return DiscOutline(self.radius**2, self.belly**2, self.edge, self.mass / self.I1)

    @property
    def size(self) -> Float[Array, "..."]:
        return jnp.maximum(self.radius, self.belly) + self.edge


class DiscOutline(AbstractMeridian):
    """A = (radius^2 - belly^2) c / h and B = edge + radius^2 / h."""

    wide: Float[Array, "..."]
    high: Float[Array, "..."]
    edge: Float[Array, "..."]
    per_inertia: Float[Array, "..."]

    def at(self, cosine: Float[Array, "..."]) -> ContactGeometry:
        flat = self.wide - self.high
        square = self.wide - flat * cosine**2
        per_height = 1.0 / jnp.sqrt(square)
        offset = flat * cosine * per_height
        growth = flat * self.wide * per_height / square
        return ContactGeometry(offset, self.edge + self.wide * per_height, self.per_inertia * offset, growth)


def test_a_body_of_ones_own_agrees_with_its_support_function():
    """The same forces as by its support function; illegal numbers are refused."""
    disc = RoundedDisc(mass=0.05, radius=0.02, belly=0.01, edge=0.003, I1=6e-6, I3=1e-5)
    by_support = tippe.ConvexBody(0.05, lambda c: 0.003 + jnp.sqrt(4e-4 - 3e-4 * c * c), 6e-6, 1e-5)
    state = jnp.array([0.1, -0.2, 0.36, 0.48, 0.8, 2e-4, -3e-4, 1e-3])
    rates = [tippe.Scene(body, friction=tippe.Viscous(0.3)).field(state) for body in (disc, by_support)]
    assert_close(*rates, rtol=1e-12, atol=1e-15)
    with pytest.raises(ValueError, match=r"belly = -0\.01 m"):
        RoundedDisc(mass=0.05, radius=0.02, belly=-0.01, edge=0.003, I1=6e-6, I3=1e-5)
