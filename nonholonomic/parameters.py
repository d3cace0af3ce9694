"""The parameters of a scene by name, such as `"scene.body.offset"` or `"launch.place[0]"`, and as text with units."""

import dataclasses
import difflib
import html
import re
from collections.abc import Iterable
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer


def numbers(root: str, tree: Any, functions: bool = True) -> dict[str, Any]:
    """Every parameter of a tree of modules under its dotted name.

    **Arguments:**

    - `root`: name of the tree itself.
    - `tree`: an `equinox.Module`.
    - `functions`: whether to include the parameters of modules that are functions, which may be arrays.

    **Returns:** dotted name -> number, in the order in which the modules declare them; `None` for an optional number
    that was omitted.
    """
    values = {}
    for field in dataclasses.fields(tree):
        name, value = f"{root}.{field.name}", getattr(tree, field.name)
        if isinstance(value, eqx.Module):
            values |= numbers(name, value, functions) if functions or not callable(value) else {}
        elif isinstance(value, tuple):
            values |= {f"{name}[{k}]": part for k, part in enumerate(value) if _is_number(part)}
        elif _is_number(value) or (value is None and field.name in getattr(tree, "units", {})):
            values[name] = value
    return values


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
    values_of_names = {name: number for root, tree in roots.items() for name, number in numbers(root, tree).items()}
    for name in values:
        if name not in values_of_names:
            raise _unknown_axis(
                name, [known_name for known_name, number in values_of_names.items() if number is not None]
            )
    return {root: _replaced(root, tree, values) for root, tree in roots.items()}


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


def _replaced(name: str, tree: Any, values: dict[str, Any]) -> Any:
    changes = {}
    for field in dataclasses.fields(tree):
        path_of_field, value = f"{name}.{field.name}", getattr(tree, field.name)
        if path_of_field in values:
            changes[field.name] = values[path_of_field]
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
    fields: dict[str, Any] = {root: type(tree).__name__}
    for field in dataclasses.fields(tree):
        name, value = f"{root}.{field.name}", getattr(tree, field.name)
        if isinstance(value, eqx.Module):
            fields |= description(name, value)
        elif isinstance(value, tuple):
            fields[name] = [np.asarray(part).tolist() for part in value]
        else:
            fields[name] = np.asarray(value).tolist() if isinstance(value, jax.Array | np.ndarray) else value
            if callable(value):
                fields[name] = getattr(value, "__qualname__", repr(value))
    return fields


#: How many numbers of an array are shown; longer arrays show the first and the last ones.
SHOWN = 4

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def readable_unit(unit: str) -> str:
    """A unit in common notation, "kg m²/s" for "kg m2 s-1"; an empty string for "1"."""
    numerator, denominator = [], []
    for part in unit.split():
        match = re.fullmatch(r"([A-Za-z]+)(-?\d+)?", part)
        if match is not None:
            name, power = match[1], int(match[2] or 1)
            (numerator if power > 0 else denominator).append(name + (str(abs(power)) if abs(power) > 1 else ""))
    text = " ".join(numerator) or ("1" if denominator else "")
    if denominator:
        text += "/" + (denominator[0] if len(denominator) == 1 else f"({' '.join(denominator)})")
    return re.sub(r"(?<=[A-Za-z])\d+", lambda power: power[0].translate(_SUPERSCRIPTS), text)


def as_text(value: Any, unit: str = "1") -> str:
    """A value as text: a number to six digits with its unit, or the first and last numbers of an array."""
    if isinstance(value, eqx.Module):
        return repr(value)
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
    return getattr(value, "__qualname__", None) or repr(value)


def contents(module: Any) -> list[tuple[str, str]]:
    """The fields of a module as (name, value as text); omitted fields are left out."""
    fields = [(field.name, getattr(module, field.name, None)) for field in dataclasses.fields(module)]
    units = getattr(module, "units", {})
    return [(name, as_text(value, units.get(name, "1"))) for name, value in fields if value is not None]


def one_line(module: Any) -> str:
    """A module in one line: `Plane(tilt=0.05 rad)`."""
    return f"{type(module).__name__}({', '.join(f'{name}={text}' for name, text in contents(module))})"


def in_lines(title: str, rows: list[tuple[str, str]]) -> str:
    """A title, followed by one line per row."""
    width = max((len(name) for name, _ in rows), default=0)
    return "\n".join([title, *(f"  {name:{width}}  {text}" for name, text in rows)])


def distinguishing_labels(starts: list[str], *groups: list[Any]) -> list[str]:
    """Labels that distinguish modules: the start of each label, followed by the differences between the modules.

    **Arguments:** `starts`: the starts of the labels; `groups`: modules of one role, such as the scenes, one per label.

    **Returns:** the labels. Equal labels are numbered.
    """
    differences_of_groups = [differences(group) for group in groups]
    names = [
        ", ".join([start, *(part for difference in differences_of_groups for part in difference[k])])
        for k, start in enumerate(starts)
    ]
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
