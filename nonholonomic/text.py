"""Texts of numbers and objects for messages, and users' objects with their arrays as separate numbers."""

import dataclasses
import difflib
import html
import inspect
import math
import operator
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Self, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, PyTree

# Users' objects, which are written for a single run, with their arrays as separate numbers.

#: The packages whose own methods are written for lanes.
OWN = ("nonholonomic", "tippe", "stroller")


class Numbers(eqx.Module):
    """An array as separate numbers, each a leaf with one value for all lanes or one per lane; and its shape."""

    numbers: tuple[Any, ...]
    shape: tuple[int, ...] = eqx.field(static=True)

    @property
    def array(self) -> Array:
        """The array."""
        return gathered(self.numbers, [self.shape])[0]

    def __jax_array__(self) -> Array:
        return self.array

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self.array, dtype)


def spread(arrays: Sequence[Array]) -> tuple[Array, ...]:
    """The numbers of arrays, one by one."""
    return tuple(number for array in arrays for number in (jnp.unstack(array.ravel()) if array.ndim else (array,)))


def gathered(numbers: Sequence[Array], shapes: Sequence[tuple[int, ...]]) -> list[Array]:
    """The arrays with the given shapes, from their `spread` numbers."""
    arrays, first = [], 0
    for shape in shapes:
        end = first + math.prod(shape)
        arrays.append(jnp.stack(numbers[first:end]).reshape(shape) if shape else numbers[first])
        first = end
    return arrays


def parted(tree: PyTree) -> PyTree:
    """A tree with `Numbers` in place of its arrays, which hold the numbers of a single run."""
    return jax.tree.map(
        lambda leaf: Numbers(spread([jnp.asarray(leaf)]), leaf.shape) if is_array(leaf) and leaf.ndim else leaf, tree
    )


def joined(tree: PyTree) -> PyTree:
    """A tree with arrays in place of its `Numbers`."""
    return jax.tree.map(lambda leaf: leaf.array if is_numbers(leaf) else leaf, tree, is_leaf=is_numbers)


def is_numbers(leaf: object) -> bool:
    """Whether a node of a tree is an array as separate numbers."""
    return isinstance(leaf, Numbers)


def is_array(leaf: object) -> bool:
    """Whether a leaf is an array of JAX or NumPy."""
    return isinstance(leaf, jax.Array | np.ndarray)


def is_users(kind: type) -> bool:
    """Whether a class is a user's, not one of these packages."""
    return kind.__module__.partition(".")[0] not in OWN


# Values of parameters as text, with units, and hints for messages.


def likely(name: object, known: Iterable[str]) -> str:
    """The known name that resembles an unknown one, as an addition to a message; empty if there is none."""
    names, text = list(known), str(name)
    anagrams = [other for other in names if sorted(other) == sorted(text)]
    # By the measure of `difflib`, a name of two letters, such as "mu", resembles no other.
    short = [other for other in names if len(other) == len(text) == 2 and any(map(operator.eq, other, text))]
    matches = anagrams or difflib.get_close_matches(text, names, 1) or short
    return f"; did you mean {matches[0]!r}?" if matches else ""


def likely_fix(value: PyTree, wanted: str = "") -> str:
    """A hint for a function or a class instead of its result, a body or a system instead of a scene, or a scene instead of a
    body.

    **Arguments:** `wanted`: name of the class that the value should have.
    """
    if inspect.isclass(value):
        return f"; did you mean {value.__name__}(...)?"
    if isinstance(value, eqx.Module) and hasattr(value, "body"):
        return "; the body of this scene is its .body"
    if wanted == "Scene" and hasattr(value, "metric"):
        return "; nonholonomic.simulate runs a system of your own, and gives gradients to optimise its numbers"
    if wanted == "Scene" and isinstance(value, eqx.Module) and hasattr(value, "mass"):
        return "; put this body into one, as in Scene(body)"
    is_preset = inspect.isfunction(value) and value.__name__ != "<lambda>"
    return f"; did you mean {value.__name__}()?" if is_preset else ""


#: Value of each unit in the SI unit of the same dimension, which a file may have and a picture may show.
UNITS = {
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "rad": {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0, "rev/s": 2.0 * math.pi},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6},
    "1": {"1": 1.0, "%": 1e-2},
}

#: Other names of units.
SYNONYMS = {"°": "deg", "degree": "deg", "degrees": "deg", "°/s": "deg/s", "radian": "rad", "radians": "rad"}
SYNONYMS |= {"sec": "s", "second": "s", "seconds": "s", "1/min": "rpm", "rev/min": "rpm", "U/min": "rpm"}
SYNONYMS |= {"turn": "rev", "turns": "rev", "turns/s": "rev/s", "rps": "rev/s", "degrees/s": "deg/s", "Grad": "deg"}

#: The unit of drawn numbers, such as "deg", or several for numbers of different dimensions; `None` for SI units.
Unit: TypeAlias = str | Sequence[str] | None

#: How many numbers of an array are shown; longer arrays show the first and the last ones.
SHOWN = 4


#: A message shows lists of up to this many values in full.
MOST_PARTS = 8


#: Length of a label that leaves room for the picture.
MOST_CHARACTERS = 30

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def readable_unit(unit: str) -> str:
    """A unit in common notation, "kg m²/s" for "kg m2 s-1"; an empty string for "1"."""
    numerator, denominator = [], []
    for part in unit.split():
        match = re.fullmatch(r"([A-Za-z]+)(-?\d+)?", part)
        if match is None and "/" in part:
            # A unit in common notation.
            numerator.append(part)
        elif match is not None:
            name, power = match[1], int(match[2] or 1)
            (numerator if power > 0 else denominator).append(name + (str(abs(power)) if abs(power) > 1 else ""))
    text = " ".join(numerator) or ("1" if denominator else "")
    if denominator:
        text += "/" + (denominator[0] if len(denominator) == 1 else f"({' '.join(denominator)})")
    return re.sub(r"(?<=[A-Za-z])\d+", lambda power: power[0].translate(_SUPERSCRIPTS), text)


def with_unit(name: str, unit: str) -> str:
    """The name of a number with its unit, if it has one: `time [s]`."""
    return f"{name} [{readable_unit(unit)}]" if readable_unit(unit) else name


def in_unit(si: str, unit: Unit) -> tuple[str, float]:
    """The unit in which to show a number in the SI unit `si`, and the factor that converts the number.

    **Arguments:** `unit`: one of `UNITS`, such as "deg", or several for numbers of different dimensions, or `None`
    for `si`; "deg", "rev", "cm" and so on also convert rates, to deg/s and so on, unless a unit of the rate is named.
    """
    readable = readable_unit(si)
    for name in _with_rates(unit):
        # A number without a unit is no percentage unless its unit says so.
        if readable and name in UNITS.get(readable, {}):
            return name, 1.0 / UNITS[readable][name]
    return si, 1.0


class Stated(eqx.Module):
    """A module that may know the units in which its user stated it, for texts and pictures. They are no field: neither the
    programs nor the gradients of a module have units, and copies are shown in SI units."""

    __slots__ = ("_unit",)

    def stated_in(self, unit: tuple[str, ...]) -> Self:
        """This module, which is shown in these units from now on."""
        object.__setattr__(self, "_unit", unit)
        return self

    def __getstate__(self) -> dict[str, object]:
        # Pickle could not set the attribute of a frozen module.
        return dict(vars(self))


def unit_of(*values: object) -> tuple[str, ...]:
    """The units in which a user stated launches and data, or the launches of data, models and runs; empty for SI units."""
    stated = [part for value in values for part in (value, getattr(value, "launch", None)) if isinstance(part, Stated)]
    return tuple(unit for part in stated for unit in getattr(part, "_unit", ()))


def _with_rates(unit: Unit) -> list[str]:
    """The units that a user names, and then the rates that they imply."""
    names = [SYNONYMS.get(name, name) for name in ([unit] if isinstance(unit, str) else unit or ())]
    return [*names, *(f"{name}/s" for name in names)]


def require_unit_of(unit: Unit, units: Mapping[str, str]) -> None:
    """Raise `ValueError` if none of the drawn numbers can be shown in a unit, as in lengths for an angle.

    **Arguments:** `unit`: as for `in_unit`; `units`: name of a number -> its SI unit.
    """
    possible = {name for si in units.values() for name in UNITS.get(readable_unit(si), {})}
    if unit and possible.isdisjoint(_with_rates(unit)):
        listed = ", ".join(with_unit(name, si) for name, si in units.items())
        raise ValueError(f"unit = {shown(unit)} fits nothing that is drawn: {listed}")


def require_unit(unit: object) -> None:
    """Raise `ValueError` unless this is `None`, a unit that pictures can show, or a list of such units."""
    known = [name for readable, names in UNITS.items() if readable != "1" for name in names]
    names, legal = [unit] if isinstance(unit, str) else unit, [*known, *SYNONYMS]
    if unit is not None and not (isinstance(names, list | tuple) and all(name in legal for name in names)):
        listed, hint = ", ".join(known), likely(unit, known)
        raise ValueError(f"unit = {shown(unit)} must be one of {listed}, or a list of them{hint}")


def as_text(value: object, unit: str | None = "1") -> str:
    """A value as text: a number to six digits with its unit, or the first and last numbers of an array. Without a unit,
    the numbers of a module have no units either."""
    value = value.array if isinstance(value, Numbers) else value
    if isinstance(value, eqx.Module):
        return repr(value) if unit is not None else one_line(value, with_units=False)
    unit = unit or "1"
    if isinstance(value, Tracer):
        return f"traced {value.aval.str_short()}"
    suffix = readable_unit(unit)
    suffix = f" {suffix}" if suffix else ""
    if isinstance(value, tuple):
        return f"({', '.join(as_text(part) for part in value)}){suffix}"
    if isinstance(value, jax.Array | np.ndarray | float) and np.asarray(value).dtype.kind in "fiu":
        numbers = np.asarray(value)
        values = numbers.ravel()
        if values.size <= SHOWN:
            text = ", ".join(f"{number:.6g}" for number in values)
        else:
            text = f"{values[0]:.6g}, {values[1]:.6g}, ..., {values[-1]:.6g}, {values.size} numbers"
        return (text if numbers.ndim == 0 else f"[{text}]") + suffix
    # A function within a function, such as a lambda, goes by its own name.
    name = getattr(value, "__qualname__", None)
    return repr(value) if name is None else name.rpartition("<locals>.")[2]


def name_of(value: object) -> str:
    """The name of a function, or the kind of another object; unlike its text, it holds no address.

    **Example:**

    >>> import functools
    >>> from nonholonomic.text import name_of
    >>> name_of(max), name_of(functools.partial(max, 1))
    ('max', 'partial')
    """
    return getattr(value, "__qualname__", type(value).__name__)


def shown(value: object) -> str:
    """The value for a message, as a user would write it: plain numbers in place of arrays, also within lists."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{shown(name)}: {shown(part)}" for name, part in value.items()) + "}"
    if isinstance(value, list) or (isinstance(value, tuple) and not hasattr(value, "_fields")):
        parts = [shown(part) for part in value]
        if len(parts) > MOST_PARTS:
            parts = [*parts[:2], "...", parts[-1], f"{len(parts)} in all"]
        opening, closing = "[]" if isinstance(value, list) else ("(", ",)" if len(parts) == 1 else ")")
        return f"{opening}{', '.join(parts)}{closing}"
    if isinstance(value, jax.Array | np.ndarray | np.generic) and not isinstance(value, Tracer):
        array = np.asarray(value)
        return as_text(array) if array.ndim and array.dtype.kind in "fiu" else shown(array.tolist())
    is_known = isinstance(value, jax.Array | np.ndarray | eqx.Module) or callable(value)
    # Of a run or a table, the first line says what it is.
    return (as_text(value) if is_known else repr(value)).partition("\n")[0]


def described(result: PyTree) -> str:
    """What a traced function returns, for a message, such as "an array of shape (2,)" or "a list of 2 values"."""
    if hasattr(result, "shape"):
        return f"an array of shape {result.shape}" if result.shape else f"a number of type {result.dtype}"
    count = f" of {counted(len(result), 'value')}" if isinstance(result, list | tuple) else ""
    return "None" if result is None else f"a {type(result).__name__}{count}"


def contents(module: PyTree, with_units: bool = True) -> list[tuple[str, str]]:
    """The fields of a module as (name, value as text); omitted fields are left out."""
    units, rows = getattr(module, "units", {}), []
    for field in dataclasses.fields(module):
        value = getattr(module, field.name, None)
        if value is not None:
            # A launch knows in which units it was stated.
            unit, factor = units.get(field.name, "1"), 1.0
            if not isinstance(value, tuple):
                unit, factor = in_unit(unit, unit_of(module))
                value = value if factor == 1.0 else factor * value
            rows.append((field.name, as_text(value, unit if with_units else None)))
    return rows


def counted(count: int, noun: str) -> str:
    """A count with its noun, such as "1 number" and "2 numbers"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def one_line(module: PyTree, with_units: bool = True) -> str:
    """A module in one line: `Plane(tilt=0.05 rad)`."""
    return f"{type(module).__name__}({', '.join(f'{name}={text}' for name, text in contents(module, with_units))})"


def distinguishing_labels(
    starts: list[tuple[str, ...]], *groups: list[Any], unit: Unit = None, longest: float = MOST_CHARACTERS
) -> list[str]:
    """Labels that distinguish runs, by what differs between them only.

    **Arguments:** `starts`: for each run, the same number of texts, such as its angle and its spin, the most important first;
    `groups`: modules of one role, such as the scenes, one per run; `unit`: units for their numbers, as for `in_unit`;
    `longest`: the number of characters that a label may have.

    **Returns:** the labels, of the parts that tell the runs apart, and of others as far as there is room; "…" stands for more.
    If nothing differs, a label is the whole start; equal labels are numbered.
    """
    columns = [texts for texts in zip(*starts, strict=True) if len(set(texts)) > 1]
    columns += [texts for group in groups for texts in zip(*differences(group, unit), strict=True)]
    names, chosen, apart = [", ".join(start) for start in starts], [], 1
    for tells_apart in (True, False):
        for column in columns:
            parts = [other for other in columns if other in chosen or other is column]
            longer = [", ".join(texts) for texts in zip(*parts, strict=True)]
            room = longest - len(", …") * (len(parts) < len(columns))
            if len(set(longer)) > apart if tells_apart else max(map(len, longer)) <= room:
                names, chosen, apart = longer, parts, len(set(longer))
    if len(chosen) < len(columns):
        names = [f"{name}, …" for name in names]
    if len(names) > 1:
        names = [name if len(name) <= longest else f"{name[: int(longest) - 1]}…" for name in names]
    count = names.count
    return [name if count(name) == 1 else f"{name} ({names[: k + 1].count(name)})" for k, name in enumerate(names)]


def differences(modules: list[Any], unit: Unit = None) -> list[list[str]]:
    """What distinguishes each module from the others, as text: its kind, or some of its parameters.

    **Arguments:** `unit`: units for their numbers, as for `in_unit`.
    """
    if len({type(module) for module in modules}) > 1:
        return [[type(module).__name__] for module in modules]
    labels: list[list[str]] = [[] for _ in modules]
    for field in dataclasses.fields(modules[0]):
        values = [getattr(module, field.name) for module in modules]
        if all(isinstance(value, eqx.Module) for value in values):
            parts = differences(values, unit)
        else:
            name, factor = in_unit(getattr(modules[0], "units", {}).get(field.name, "1"), unit)
            if factor != 1.0:
                # 0.1 rad is 5.73 deg, not 5.72958.
                rounded = np.vectorize(lambda number, factor=factor: float(f"{factor * number:.4g}"), otypes=[float])
                values = [jax.tree.map(rounded, value) for value in values]
            texts = [f"no {field.name}" if part is None else f"{field.name} {as_text(part, name)}" for part in values]
            parts = [[text] if len(set(texts)) > 1 else [] for text in texts]
        labels = [label + part for label, part in zip(labels, parts, strict=True)]
    return labels


def as_html(title: str, rows: list[tuple[str, ...]]) -> str:
    """A title and a table of rows, as HTML for a notebook."""
    style = "text-align: left; vertical-align: top"
    cells = ("".join(f'<td style="{style}">{html.escape(text)}</td>' for text in row) for row in rows)
    return f"<div><b>{html.escape(title)}</b><table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table></div>"


def text_as_html(value: object) -> str:
    """A value whose text begins with a title in a line of its own, as HTML for a notebook."""
    title, _, body = str(value).partition("\n")
    return f"<div><b>{html.escape(title)}</b><pre>{html.escape(body)}</pre></div>"
