"""The parameters of a scene by name, such as `"scene.body.offset"` or `"launch.place[0]"`, and as text with units."""

import dataclasses
import difflib
import html
import inspect
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from .per_run import AbstractHeld, Numbers


def numbers(root: str, tree: Any, functions: bool = True) -> dict[str, Any]:
    """Every parameter of a tree of modules under its dotted name.

    **Arguments:**

    - `root`: name of the tree itself.
    - `tree`: an `equinox.Module`.
    - `functions`: whether to include the parameters of modules that are functions, which may be arrays.

    **Returns:** dotted name -> number, in the order in which the modules declare them; `None` for an optional number
    that was omitted.
    """
    values, tree = {}, _itself(tree)
    for field in dataclasses.fields(tree):
        name, value = f"{root}.{field.name}", getattr(tree, field.name)
        if isinstance(value, Numbers):
            values |= dict(zip(_entries(name, value), value.numbers, strict=True))
        elif isinstance(value, eqx.Module):
            values |= numbers(name, value, functions) if functions or not callable(value) else {}
        elif isinstance(value, tuple):
            values |= {f"{name}[{k}]": part for k, part in enumerate(value) if _is_number(part)}
        elif _is_number(value) or (value is None and field.name in getattr(tree, "units", {})):
            values[name] = value
    return values


def numbers_of(roots: dict[str, Any]) -> dict[str, Any]:
    """Every parameter of several trees. **Arguments:** `roots`: name -> tree."""
    return {name: value for root, tree in roots.items() for name, value in numbers(root, tree).items()}


def _itself(tree: Any) -> Any:
    """The user's module itself for a module that is evaluated over lanes."""
    return tree.function if isinstance(tree, AbstractHeld) else tree


def _entries(name: str, array: Numbers) -> list[str]:
    """The names of the numbers of an array, such as `knots[2]`."""
    return [name + "".join(f"[{k}]" for k in index) for index in np.ndindex(array.shape)]


def _is_number(value: Any) -> bool:
    return isinstance(value, jax.Array | np.ndarray | float)


def with_numbers(roots: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """The trees with some parameters replaced; the modules check the new values.

    **Arguments:**

    - `roots`: name -> tree.
    - `values`: dotted name -> number or array of numbers.

    **Returns:** name -> tree.

    **Raises:** `ValueError` for a name that matches no parameter.
    """
    values_of_names = numbers_of(roots)
    for name in values:
        if name not in values_of_names:
            raise _unknown_axis(
                name, [known_name for known_name, number in values_of_names.items() if number is not None]
            )
    return {root: _replaced(root, tree, values) for root, tree in roots.items()}


def as_one(values: Any, name: str, kind: type) -> Any:
    """Several modules of one kind, such as launches, as one whose numbers are lists, with one value for each module.
    Anything but a list of such modules stays unchanged.

    **Arguments:** `name`: name of the list in messages.

    **Raises:** `ValueError` for modules whose numbers are lists already, or that leave out numbers without a default
    of zero that others have.
    """
    if not isinstance(values, list | tuple) or not values or not all(isinstance(value, kind) for value in values):
        return values
    stacked = {}
    for field in dataclasses.fields(kind):
        parts = [getattr(value, field.name) for value in values]
        counts = {len(part) for part in parts if isinstance(part, tuple)}
        if len(counts) > 1 or (field.name not in RESTING and counts and None in parts):
            sizes = ", ".join("none" if part is None else str(len(part)) for part in parts)
            raise ValueError(f"{name}: {field.name} must have the same number of coordinates in all, not {sizes}")
        if counts:
            zeros = (0.0,) * counts.pop()
            rows = zip(*(zeros if part is None else part for part in parts), strict=True)
            stacked[field.name] = tuple(_column(row, name, field.name) for row in rows)
        else:
            stacked[field.name] = None if None in parts else _column(parts, name, field.name)
    return kind(**stacked)


#: Parts of a launch that are zero where they are left out.
RESTING = ("velocity", "angular_velocity")


def _column(parts: Any, name: str, field: str) -> Any:
    """One number of each module as an array."""
    shapes = {np.shape(part) for part in parts}
    if shapes != {()}:
        raise ValueError(f"{name}: {field} must be one number in each of the list, not of shape {max(shapes, key=len)}")
    return jnp.stack([jnp.asarray(part) for part in parts])


def full_name(argument: str, name: str, known: list[str]) -> str:
    """The full name for a name: the name itself, or the only full name that ends with it.

    **Arguments:** `argument`: the argument that contains the name, for messages; `name`: such as `"scene.friction.mu"`
    or `"friction.mu"`; `known`: the full names to choose from.

    **Raises:** `ValueError` for a name that matches no full name or several.
    """
    matches = _meant(name, known)
    if len(matches) != 1:
        ends = [candidate.rsplit(".", 1)[-1] for candidate in known]
        hint = likely(str(name).rsplit(".", 1)[-1], ends)
        problem = f"could be {' or '.join(matches)}" if matches else f"must be one of {', '.join(known)}{hint}"
        raise ValueError(f"{argument}: {name!r} {problem}")
    return matches[0]


def full_axes(axes: dict[str, Any], known: list[str]) -> dict[str, Any]:
    """The axes of a grid under full names; a name may be the end of a full name, such as `"offset"`.

    **Arguments:** `axes`: name -> values; `known`: the full names of the parameters.

    **Raises:** `ValueError` for a name that matches none or several parameters, and for a parameter that is named
    twice.
    """
    by_full_name: dict[str, Any] = {}
    for name, values in axes.items():
        if not _meant(name, known):
            raise _unknown_axis(name, known)
        full = full_name("axes", name, known)
        if full in by_full_name:
            raise ValueError(f"axes: {full!r} is named twice")
        by_full_name[full] = values
    return by_full_name


def _meant(name: Any, known: list[str]) -> list[str]:
    """The full names that match a name."""
    return [name] if name in known else [known_name for known_name in known if known_name.endswith("." + str(name))]


def _unknown_axis(name: str, known: list[str]) -> ValueError:
    suffixes = {full.rsplit(".", 1)[-1]: full for full in known}
    return ValueError(
        f"unknown axis {name!r}: the numbers that can be varied are {', '.join(known)}"
        f"{likely(name.rsplit('.', 1)[-1], suffixes)}"
    )


def likely(name: Any, known: Iterable[str]) -> str:
    """The known name that resembles an unknown one, as an addition to a message; empty if there is none."""
    names = list(known)
    anagrams = [candidate for candidate in names if sorted(candidate) == sorted(str(name))]
    matches = anagrams or difflib.get_close_matches(str(name), names, 1)
    return f"; did you mean {matches[0]!r}?" if matches else ""


def likely_fix(value: Any, wanted: str = "") -> str:
    """A hint for a function or a class instead of its result, a body instead of a scene, or a scene instead of a body.

    **Arguments:** `wanted`: name of the class that the value should have.
    """
    if inspect.isclass(value):
        return f"; did you mean {value.__name__}(...)?"
    if isinstance(value, eqx.Module) and hasattr(value, "body"):
        return "; the body of this scene is its .body"
    if wanted == "Scene" and isinstance(value, eqx.Module) and hasattr(value, "mass"):
        return "; put this body into one, as in Scene(body)"
    return f"; did you mean {value.__name__}()?" if inspect.isfunction(value) else ""


def _replaced(name: str, tree: Any, values: dict[str, Any]) -> Any:
    if isinstance(tree, AbstractHeld):
        return type(tree)(_replaced(name, tree.function, values))
    changes = {}
    for field in dataclasses.fields(tree):
        path_of_field, value = f"{name}.{field.name}", getattr(tree, field.name)
        if path_of_field in values:
            changes[field.name] = values[path_of_field]
        elif isinstance(value, Numbers):
            entries = zip(_entries(path_of_field, value), value.numbers, strict=True)
            changes[field.name] = Numbers(tuple(values.get(entry, part) for entry, part in entries), value.shape)
        elif isinstance(value, tuple):
            parts = tuple(values.get(f"{path_of_field}[{k}]", part) for k, part in enumerate(value))
            if any(f"{path_of_field}[{k}]" in values for k in range(len(value))):
                changes[field.name] = parts
        elif isinstance(value, eqx.Module) and any(path.startswith(path_of_field + ".") for path in values):
            changes[field.name] = _replaced(path_of_field, value, values)
    return dataclasses.replace(tree, **changes) if changes else tree


def description(root: str, tree: Any) -> dict[str, Any]:
    """A tree of modules as plain data: the kind of every module and the value of every number.

    A function is described by its name alone.
    """
    tree = _itself(tree)
    fields: dict[str, Any] = {root: type(tree).__name__}
    for field in dataclasses.fields(tree):
        name, value = f"{root}.{field.name}", getattr(tree, field.name)
        if isinstance(value, Numbers):
            fields[name] = np.asarray(value).tolist()
        elif isinstance(value, eqx.Module):
            fields |= description(name, value)
        elif isinstance(value, tuple):
            fields[name] = [np.asarray(part).tolist() for part in value]
        else:
            fields[name] = np.asarray(value).tolist() if isinstance(value, jax.Array | np.ndarray) else value
            if callable(value):
                fields[name] = getattr(value, "__qualname__", repr(value))
    return fields


#: Value of each unit in the SI unit of the same dimension, which a file may have and a picture may show.
UNITS = {
    "s": {"s": 1.0, "ms": 1e-3, "min": 60.0},
    "rad": {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": math.pi / 30.0, "rev/s": 2.0 * math.pi},
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3},
    "m/s": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6},
    "1": {"1": 1.0, "%": 1e-2},
}

#: How many numbers of an array are shown; longer arrays show the first and the last ones.
SHOWN = 4

#: A message shows lists of up to this many values in full.
MOST_PARTS = 8

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


def in_unit(si: str, unit: str | Sequence[str]) -> tuple[str, float]:
    """The unit in which to show a number in the SI unit `si`, and the factor that converts the number.

    **Arguments:** `unit`: one of `UNITS`, such as "deg", or several for numbers of different dimensions; "deg", "rev", "cm"
    and so on also convert rates, to deg/s and so on, unless a unit of the rate is named.
    """
    readable, names = readable_unit(si), [unit] if isinstance(unit, str) else [*unit]
    for name in [*names, *(f"{name}/s" for name in names)]:
        # A number without a unit is no percentage unless its unit says so.
        if readable and name in UNITS.get(readable, {}):
            return name, 1.0 / UNITS[readable][name]
    return si, 1.0


def require_unit(unit: Any) -> None:
    """Raise `ValueError` unless this is `None`, a unit that pictures can show, or a list of such units."""
    known = [name for readable, names in UNITS.items() if readable != "1" for name in names]
    names = [unit] if isinstance(unit, str) else unit
    if unit is not None and not (isinstance(names, list | tuple) and all(name in known for name in names)):
        hint = likely(unit, known) if isinstance(unit, str) else ""
        raise ValueError(f"unit = {shown(unit)} must be one of {', '.join(known)}, or a list of them{hint}")


def as_text(value: Any, unit: str | None = "1") -> str:
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


def shown(value: Any) -> str:
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
    return as_text(value) if isinstance(value, jax.Array | np.ndarray | eqx.Module) or callable(value) else repr(value)


def contents(module: Any, with_units: bool = True) -> list[tuple[str, str]]:
    """The fields of a module as (name, value as text); omitted fields are left out."""
    fields = [(field.name, getattr(module, field.name, None)) for field in dataclasses.fields(module)]
    units = getattr(module, "units", {})
    fields = [(name, value, units.get(name, "1") if with_units else None) for name, value in fields]
    return [(name, as_text(value, unit)) for name, value, unit in fields if value is not None]


def one_line(module: Any, with_units: bool = True) -> str:
    """A module in one line: `Plane(tilt=0.05 rad)`."""
    return f"{type(module).__name__}({', '.join(f'{name}={text}' for name, text in contents(module, with_units))})"


def in_lines(title: str, rows: list[tuple[str, str]]) -> str:
    """A title, followed by one line per row."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([title, *(f"  {name:{width}}  {text}" for name, text in rows)])


def distinguishing_labels(starts: list[tuple[str, ...]], *groups: list[Any]) -> list[str]:
    """Labels that distinguish runs, by what differs between them only.

    **Arguments:** `starts`: for each run, the same number of texts, such as its angle and its spin; `groups`: modules of
    one role, such as the scenes, one per run.

    **Returns:** the labels. If nothing differs, a label is the whole start; equal labels are numbered.
    """
    differing = [k for k, texts in enumerate(zip(*starts, strict=True)) if len(set(texts)) > 1]
    parts = [[start[k] for k in differing] for start in starts]
    for group in groups:
        parts = [part + difference for part, difference in zip(parts, differences(group), strict=True)]
    names = [", ".join(part or start) for part, start in zip(parts, starts, strict=True)]
    return [
        name if names.count(name) == 1 else f"{name} ({names[: k + 1].count(name)})" for k, name in enumerate(names)
    ]


def differences(modules: list[Any]) -> list[list[str]]:
    """What distinguishes each module from the others, as text: its kind, or some of its parameters."""
    if len({type(module) for module in modules}) > 1:
        return [[type(module).__name__] for module in modules]
    labels: list[list[str]] = [[] for _ in modules]
    for field in dataclasses.fields(modules[0]):
        values = [getattr(module, field.name) for module in modules]
        if all(isinstance(value, eqx.Module) for value in values):
            parts = differences(values)
        else:
            unit = getattr(modules[0], "units", {}).get(field.name, "1")
            texts = [as_text(value, unit) for value in values]
            parts = [[f"{field.name} {text}"] if len(set(texts)) > 1 else [] for text in texts]
        labels = [label + part for label, part in zip(labels, parts, strict=True)]
    return labels


def as_html(title: str, rows: list[tuple[str, ...]]) -> str:
    """A title and a table of rows, as HTML for a notebook."""
    style = "text-align: left; vertical-align: top"
    cells = ("".join(f'<td style="{style}">{html.escape(text)}</td>' for text in row) for row in rows)
    return f"<div><b>{html.escape(title)}</b><table>{''.join(f'<tr>{row}</tr>' for row in cells)}</table></div>"


def text_as_html(text: str) -> str:
    """A text whose first line is a title, as HTML for a notebook."""
    title, _, body = text.partition("\n")
    return f"<div><b>{html.escape(title)}</b><pre>{html.escape(body)}</pre></div>"
