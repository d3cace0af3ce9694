"""Users' objects with arrays, which are written for one run: methods over lanes, and the numbers of arrays by name."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from close import assert_close

import tippe
from nonholonomic import AbstractSurface
from nonholonomic.geometry.surface import as_surface
from nonholonomic.parameters import description, numbers, with_numbers
from tippe.friction import AbstractFriction, ContactLoad, Slip, as_law

KNOTS = np.array([0.0, 0.1, 0.2, 0.5, 2.0])


class Sums(AbstractFriction):
    """A viscous law whose coefficient is a sum over an array."""

    weights: jax.Array

    def per_normal_force(self, slip):
        return ContactLoad(force=(-jnp.sum(self.weights * slip.x), -jnp.sum(self.weights * slip.y)))


class Measured(AbstractFriction):
    """A curve through measured points, whose interpolation looks indices up."""

    speeds: jax.Array
    values: jax.Array

    def per_normal_force(self, slip):
        speed = jnp.sqrt(slip.x**2 + slip.y**2 + 1e-12)
        factor = -jnp.interp(speed, self.speeds, self.values) / speed
        return ContactLoad(force=(factor * slip.x, factor * slip.y))


class Slope(AbstractSurface):
    """A surface with a matrix; only its normal is of interest."""

    matrix: jax.Array

    def normal(self, position):
        slope = self.matrix @ jnp.stack(position[:2])
        length = jnp.sqrt(1.0 + slope @ slope)
        return (-slope[0] / length, -slope[1] / length, 1.0 / length)

    def normal_rate(self, position, velocity):
        raise NotImplementedError

    bending = elevation = gaussian_curvature = nearest = place_at = charted = normal_rate


@pytest.mark.parametrize("law", [Sums(jnp.array([0.1, 0.2])), Measured(jnp.asarray(KNOTS), jnp.asarray(0.3 * KNOTS))])
@pytest.mark.parametrize("lanes", [2, 5, 7])
def test_a_law_with_arrays_is_evaluated_lane_by_lane(law, lanes):
    """Both are viscous laws with 0.3 s/m; as many lanes as numbers were once paired with them."""
    x, y = jnp.linspace(0.1, 0.9, lanes), jnp.linspace(-0.5, 0.5, lanes)
    force = eqx.filter_jit(as_law(law).per_normal_force)(Slip(x, y, (x, x, x))).force
    assert_close(force[0], -0.3 * x, rtol=1e-9)
    assert_close(force[1], -0.3 * y, atol=1e-9)


def test_a_surface_with_arrays_is_evaluated_lane_by_lane():
    surface = Slope(jnp.array([[0.3, 0.1], [0.1, 0.5]]))
    points = np.random.default_rng(0).normal(size=(3, 2))
    normal = as_surface(surface).normal((*jnp.asarray(points.T), jnp.zeros(3)))
    slopes = points @ np.asarray(surface.matrix)
    expected = np.column_stack([-slopes, np.ones(3)]) / np.sqrt(1.0 + np.sum(slopes**2, axis=1))[:, None]
    assert_close(jnp.stack(normal, axis=1), expected, rtol=1e-14)


def test_numbers_with_one_value_per_lane_are_no_array_of_one_law():
    """A law of numbers stays a law of numbers, of which each may be a list with one value for each launch."""

    class Own(AbstractFriction):
        mu: jax.Array

        def per_normal_force(self, slip):
            return ContactLoad(force=(-self.mu * slip.x, -self.mu * slip.y))

    law, x = as_law(Own(jnp.array([0.1, 0.2, 0.3]))), jnp.ones(3)
    assert_close(law.mu, [0.1, 0.2, 0.3])
    assert_close(law.per_normal_force(Slip(x, x)).force[0], [-0.1, -0.2, -0.3])


def test_the_numbers_of_an_array_have_names():
    top = tippe.Top(0.02, 0.02, 0.006, 2.994e-6, 3.2e-6)
    scene = tippe.Scene(top, friction=Measured(KNOTS, 0.3 * KNOTS))
    names = [name for name in numbers("scene", scene) if "friction" in name]
    assert names == [f"scene.friction.{part}[{k}]" for part in ("speeds", "values") for k in range(5)]
    changed_scene = with_numbers({"scene": scene}, {"scene.friction.values[1]": 0.5})["scene"]
    assert_close(np.asarray(changed_scene.friction.values), [0.0, 0.5, 0.06, 0.15, 0.6])
    assert description("scene", changed_scene)["scene.friction.values"] == [0.0, 0.5, 0.06, 0.15, 0.6]
    assert "[0, 0.5, ..., 0.6, 5 numbers]" in str(changed_scene)
