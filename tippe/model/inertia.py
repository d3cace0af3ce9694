"""The inertia tensor of a rigid body, and symmetric matrices stored by their six components."""

from collections.abc import Iterator
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from nonholonomic.geometry import Vector, scale, vector_of
from nonholonomic.validation import Bound, Bounded, as_number, is_traced, shown

#: Rounding error allowed in the moments of a flat body, as a fraction of their sum.
FLAT = 1e-12

#: Names of the components of inertia.
COMPONENTS = ("xx", "yy", "zz", "xy", "xz", "yz")

#: Degrees of the principal minors of a matrix in its components, in the order of `SymmetricMatrix.principal_minors`.
DEGREES = (1, 1, 1, 2, 2, 2, 3)


class Inertia(Bounded):
    """The inertia tensor about the centre of mass, in the body's axes, by its six components [kg m^2].

    The off-diagonal components are those of the matrix: `xy` is minus the integral of x y over the mass. `RigidBody` and
    `Ellipsoid` create it from a symmetric matrix (3, 3).

    **Raises:** `ValueError` for a tensor that is impossible for a rigid body: the principal moments must be positive,
    and the largest at most the sum of the other two.
    """

    units: ClassVar[dict[str, str]] = dict.fromkeys(COMPONENTS, "kg m2")

    xx: Float[Array, "..."] = eqx.field(converter=as_number)
    yy: Float[Array, "..."] = eqx.field(converter=as_number)
    zz: Float[Array, "..."] = eqx.field(converter=as_number)
    xy: Float[Array, "..."] = eqx.field(converter=as_number)
    xz: Float[Array, "..."] = eqx.field(converter=as_number)
    yz: Float[Array, "..."] = eqx.field(converter=as_number)

    @classmethod
    def of(cls, matrix: Any) -> "Inertia":
        """The tensor from a symmetric matrix (3, 3); for a traced matrix, its symmetric part."""
        if isinstance(matrix, Inertia):
            return matrix
        values = as_number(matrix)
        if not eqx.is_array(values) or values.shape != (3, 3):
            raise ValueError(
                f"inertia = {shown(matrix)} must be a matrix of shape (3, 3), in kg m^2 about the centre of mass"
            )
        if not is_traced(values):
            asymmetry = np.abs(np.asarray(values) - np.asarray(values).T)
            if np.any(asymmetry > 1e-12 * np.max(np.abs(values))):
                row, column = np.unravel_index(np.argmax(asymmetry), (3, 3))
                entry, mirrored = float(values[row, column]), float(values[column, row])
                raise ValueError(
                    f"inertia must be symmetric: inertia[{row}][{column}] = {entry:g}, inertia[{column}][{row}] = {mirrored:g}"
                )
        values = 0.5 * (values + values.T)
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = values
        return cls(xx, yy, zz, xy, xz, yz)

    def bounds(self) -> Iterator[Bound]:
        for name in COMPONENTS:
            yield Bound(getattr(self, name), name)
        xx, yy, zz, xy, xz, yz = self.numbers
        half = 0.5 * (xx + yy + zz)
        # Half the trace minus the tensor is the matrix of the second moments of the mass, which is positive
        # semidefinite; the tensor is positive definite. Both are divided by powers of the trace, so that rounding
        # errors are comparable.
        second = SymmetricMatrix(half - xx, half - yy, half - zz, -xy, -xz, -yz)
        reason = "the largest principal moment of a rigid body is at most the sum of the other two" + self._moments
        for number, degree in zip(second.principal_minors, DEGREES, strict=True):
            yield Bound(number / half**degree, "inertia: excess of moments", at_least=-FLAT, why=reason)
        for number, degree in zip(self.tensor.principal_minors, DEGREES, strict=True):
            positive = f"the principal moments of a rigid body are positive{self._moments}"
            yield Bound(number / half**degree, "inertia: product of moments", above=0.0, why=positive)

    @property
    def numbers(self) -> tuple[Float[Array, "..."], ...]:
        """The six components, in the order of the fields."""
        return self.xx, self.yy, self.zz, self.xy, self.xz, self.yz

    @property
    def tensor(self) -> "SymmetricMatrix":
        """The tensor, without checks."""
        return SymmetricMatrix(*self.numbers)

    @property
    def matrix(self) -> Float[Array, "3 3"]:
        """The tensor as a matrix."""
        xx, yy, zz, xy, xz, yz = self.numbers
        return jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])

    @property
    def _moments(self) -> str:
        """The principal moments of a known tensor, as an addition to messages."""
        if any(is_traced(number) or np.ndim(number) for number in self.numbers):
            return ""
        # In NumPy: inside a transformation, JAX would trace this even for known numbers.
        xx, yy, zz, xy, xz, yz = map(float, self.numbers)
        moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        return f"; here they are {', '.join(f'{moment:.4g}' for moment in moments)}"


class SymmetricMatrix(eqx.Module):
    """A symmetric matrix as six components, each a scalar or one per lane."""

    xx: Float[Array, "..."]
    yy: Float[Array, "..."]
    zz: Float[Array, "..."]
    xy: Float[Array, "..."]
    xz: Float[Array, "..."]
    yz: Float[Array, "..."]

    def times(self, vector: Vector) -> Vector:
        """The product with a vector."""
        x, y, z = vector
        return (
            self.xx * x + self.xy * y + self.xz * z,
            self.xy * x + self.yy * y + self.yz * z,
            self.xz * x + self.yz * y + self.zz * z,
        )

    @property
    def adjugate(self) -> "SymmetricMatrix":
        """The matrix of the cofactors."""
        xx, yy, zz, xy, xz, yz = self.xx, self.yy, self.zz, self.xy, self.xz, self.yz
        diagonal = (yy * zz - yz * yz, xx * zz - xz * xz, xx * yy - xy * xy)
        return SymmetricMatrix(*diagonal, xz * yz - xy * zz, xy * yz - xz * yy, xy * xz - yz * xx)

    def determinant(self, adjugate: "SymmetricMatrix") -> Float[Array, "..."]:
        """The determinant, from the cofactors."""
        return self.xx * adjugate.xx + self.xy * adjugate.xy + self.xz * adjugate.xz

    @property
    def inverse(self) -> "SymmetricMatrix":
        """The inverse."""
        adjugate = self.adjugate
        determinant = self.determinant(adjugate)
        return jax.tree.map(lambda cofactor: cofactor / determinant, adjugate)

    def solve(self, right: Vector) -> Vector:
        """Solution x of A x = right."""
        adjugate = self.adjugate
        return vector_of(scale(1.0 / self.determinant(adjugate), adjugate.times(right)))

    @property
    def principal_minors(self) -> tuple[Float[Array, "..."], ...]:
        """The seven principal minors, from one row to three rows; all are nonnegative if the matrix is positive
        semidefinite."""
        adjugate = self.adjugate
        minors = (self.xx, self.yy, self.zz, adjugate.xx, adjugate.yy, adjugate.zz)
        return (*minors, self.determinant(adjugate))
