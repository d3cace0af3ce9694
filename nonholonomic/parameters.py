"""The parameters of modules by name.

Those of a scene are the numbers in its fields, such as `"scene.body.offset"` or `"launch.place[0]"`; the modules check the
values that replace them. Those of a user's system are all its numbers, such as `"system.modes[0].drag"`, `"start[1]"`,
`"start.q[0]"` or `"event.level"`, in a form that can be a constant of a program. `"system.modes[*].drag"` is one number for
all modes that have it.
"""

import dataclasses
import math
import re
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import DictKey
from jaxtyping import Array, ArrayLike, Float, PyTree

from .compilation.components import Held, functions_in, outside
from .text import MOST_PARTS, Numbers, Stated, gathered, likely, name_of, spread, unit_of


def numbers(root: str, tree: PyTree, functions: bool = True) -> dict[str, Any]:
    """Every parameter of a tree of modules under its dotted name.

    **Arguments:**

    - `root`: name of the tree itself.
    - `tree`: an `equinox.Module`.
    - `functions`: whether to include the parameters of modules that are functions, which may be arrays.

    **Returns:** dotted name -> number, in the order in which the modules declare them; `None` for an optional number
    that was omitted.
    """
    values, tree = {}, tree.function if isinstance(tree, Held) else tree
    for field in dataclasses.fields(tree):
        name, value = f"{root}.{field.name}", getattr(tree, field.name)
        if parts := _parts(name, value):
            values |= {entry: part for entry, part in parts.items() if is_number(part)}
        elif isinstance(value, eqx.Module):
            values |= numbers(name, value, functions) if functions or not callable(value) else {}
        elif is_number(value) or (value is None and field.name in getattr(tree, "units", {})):
            values[name] = value
    return values


def numbers_of(roots: dict[str, PyTree]) -> dict[str, Any]:
    """Every parameter of several trees. **Arguments:** `roots`: name -> tree."""
    return {name: value for root, tree in roots.items() for name, value in numbers(root, tree).items()}


def _parts(name: str, value: Any) -> dict[str, Any]:
    """The parts of a tuple or of an array of `Numbers`, by name; empty for any other value."""
    if isinstance(value, Numbers):
        return dict(zip(_entries(name, value.shape), value.numbers, strict=True))
    return {f"{name}[{k}]": part for k, part in enumerate(value)} if isinstance(value, tuple) else {}


def _entries(name: str, shape: tuple[int, ...]) -> list[str]:
    """The names of the numbers of an array, such as `knots[2]`."""
    return [name + "".join(f"[{k}]" for k in index) for index in np.ndindex(shape)]


def is_number(leaf: object) -> bool:
    """Whether a leaf of a tree is a number or an array of numbers, which may differ from cell to cell."""
    return eqx.is_array(leaf) or isinstance(leaf, np.ndarray | np.inexact | float)


def with_numbers(roots: dict[str, PyTree], values: Mapping[str, ArrayLike]) -> dict[str, PyTree]:
    """The trees with some parameters replaced; the modules check the new values.

    **Arguments:**

    - `roots`: name -> tree.
    - `values`: dotted name -> number or array of numbers.

    **Returns:** name -> tree.

    **Raises:** `ValueError` for a name that matches no parameter.
    """
    values_of_names = numbers_of(roots)
    known = [name for name, value in values_of_names.items() if value is not None]
    values = {
        name if name in values_of_names else full_name("unknown axis", name, known): values[name] for name in values
    }
    return {root: _replaced(root, tree, values) for root, tree in roots.items()}


def as_one(values: Any, name: str, kind: type) -> Any:
    """Several modules of one kind, such as launches, as one whose numbers are lists, with one value for each module.
    Anything but a list of such modules stays unchanged. The module is shown in the units of the first.

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
    return kind(**stacked).stated_in(unit_of(values[0])) if issubclass(kind, Stated) else kind(**stacked)


#: Parts of a launch that are zero where they are left out.
RESTING = ("velocity", "angular_velocity")


def _column(parts: Sequence[ArrayLike], name: str, field: str) -> Array:
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
    matches = meant(name, known)
    if len(matches) != 1:
        several = " or ".join(matches)
        problem = f"could be {several}" if matches else _unknown(name, known)
        raise ValueError(f"{argument}: {name!r} {problem}")
    return matches[0]


class ByName(dict[str, Any]):
    """Values by the full names of parameters; to read one, the unambiguous end of its name is enough.

    **Example:**

    >>> from nonholonomic.parameters import ByName
    >>> ByName({"scene.friction.mu": 0.3, "launch.spin": 150.0})["mu"]
    0.3
    """

    def __missing__(self, name: str) -> Any:
        try:
            return self[full_name("name", name, list(self))]
        except ValueError as error:
            raise KeyError(str(error)) from None


def meant(name: Any, known: Sequence[str]) -> list[str]:
    """The full names that match a name."""
    return [name] if name in known else [known_name for known_name in known if known_name.endswith("." + str(name))]


def _unknown(name: object, known: Sequence[str]) -> str:
    """What is wrong with an unknown name, and what it may mean: the numbers of a module or an array, or a similar name. Of an
    array with many numbers, the message names the first and the last."""
    arrays: dict[str, list[str]] = {}
    for full in known:
        arrays.setdefault(re.sub(r"(\[\d+\])+$", "", full), []).append(full)
    listed = (f"{own[0]}, ..., {own[-1]}" if len(own) > MOST_PARTS else ", ".join(own) for own in arrays.values())
    hint = likely(str(name).rsplit(".", 1)[-1], [full.rsplit(".", 1)[-1] for full in known])
    if parts := re.findall(rf"\.({re.escape(str(name))}[.\[].*)", "\n".join(known)):
        hint = f"; did you mean {' or '.join(map(repr, parts[:3]))}?"
    return f"must be one of {', '.join(listed)}{hint}"


def _replaced(name: str, tree: PyTree, values: Mapping[str, Any]) -> PyTree:
    if isinstance(tree, Held):
        return type(tree)(_replaced(name, tree.function, values))
    changes = {}
    for field in dataclasses.fields(tree):
        path_of_field, value = f"{name}.{field.name}", getattr(tree, field.name)
        parts = _parts(path_of_field, value)
        if path_of_field in values:
            changes[field.name] = values[path_of_field]
        elif isinstance(value, Numbers) or not parts.keys().isdisjoint(values):
            new = tuple(values.get(entry, part) for entry, part in parts.items())
            changes[field.name] = Numbers(new, value.shape) if isinstance(value, Numbers) else new
        elif isinstance(value, eqx.Module) and any(path.startswith(path_of_field + ".") for path in values):
            changes[field.name] = _replaced(path_of_field, value, values)
    return dataclasses.replace(tree, **changes) if changes else tree


def description(root: str, tree: PyTree) -> dict[str, Any]:
    """A tree of modules as plain data: the kind of every module and the value of every number.

    A function is described by its name alone. Nothing in the data is different in another process.
    """
    tree = tree.function if isinstance(tree, Held) else tree
    fields: dict[str, Any] = {root: type(tree).__name__}
    for field in dataclasses.fields(tree):
        name, value = f"{root}.{field.name}", getattr(tree, field.name)
        is_module = isinstance(value, eqx.Module) and not isinstance(value, Numbers)
        fields |= description(name, value) if is_module else {name: _plain_data(value)}
    return fields


def _plain_data(value: object) -> object:
    """A value as JSON can store it; other objects are described by their kind, because their text can be an address."""
    if isinstance(value, jax.Array | np.ndarray | np.generic | Numbers):
        return np.asarray(value).tolist()
    if isinstance(value, tuple | list):
        return [_plain_data(part) for part in value]
    if isinstance(value, dict):
        return {str(name): _plain_data(part) for name, part in value.items()}
    if isinstance(value, eqx.Module):
        return description("self", value)
    if value is None or isinstance(value, str | bool | int | float):
        return value
    return name_of(value)


@dataclasses.dataclass(frozen=True)
class TreeForm:
    """A tree without its numbers, which are listed one by one, in order within each array.

    - `structure`: structure of the tree; `leaves`: its leaves, with `None` for each array of numbers.
    - `kinds`: shape and type of each array of numbers; `outside`: what the functions of the tree read from `outside` of it.
    """

    structure: Any
    leaves: tuple[Hashable, ...]
    kinds: tuple[tuple[tuple[int, ...], np.dtype], ...]
    outside: Hashable = None

    @classmethod
    def of(cls, tree: PyTree) -> tuple["TreeForm", tuple[Array, ...]]:
        """The form of a tree, and its numbers."""
        leaves, structure = jax.tree.flatten(tree)
        # With the type stated, one program serves Python's numbers and arrays.
        arrays = [jnp.asarray(leaf, jnp.result_type(leaf)) for leaf in leaves if is_number(leaf)]
        static_leaves = tuple(None if is_number(leaf) else leaf for leaf in leaves)
        kinds = tuple((array.shape, array.dtype) for array in arrays)
        return cls(structure, static_leaves, kinds, outside(functions_in(tree), set())), spread(arrays)

    def tree(self, numbers: Sequence[Array]) -> PyTree:
        """The tree with the given numbers, each a scalar."""
        arrays = iter(gathered(numbers, [shape for shape, _ in self.kinds]))
        return jax.tree.unflatten(self.structure, [next(arrays) if leaf is None else leaf for leaf in self.leaves])

    @property
    def types(self) -> tuple[jax.ShapeDtypeStruct, ...]:
        """The types of the numbers."""
        return tuple(jax.ShapeDtypeStruct((), kind) for shape, kind in self.kinds for _ in range(math.prod(shape)))


class Parameters(eqx.Module):
    """The numbers of a tree of a user's modules, one by one, by name.

    - `values`: the numbers, scalars or arrays with one number per cell; `names`: their names, in the same order.
    - `form`: the rest of the tree.
    """

    values: tuple[Float[Array, "..."], ...]
    names: tuple[str, ...] = eqx.field(static=True)
    form: TreeForm = eqx.field(static=True)

    @classmethod
    def of(cls, tree: dict[str, PyTree]) -> "Parameters":
        """The numbers of several named trees."""
        form, values = TreeForm.of(tree)
        leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, is_number))
        names: list[str] = []
        for path, leaf in leaves:
            parts = (f".{key.key}" if isinstance(key, DictKey) else str(key) for key in path)
            names += _entries("".join(parts).removeprefix("."), np.shape(leaf))
        return cls(values, tuple(names), form)

    @property
    def tree(self) -> dict[str, PyTree]:
        """The trees, for values that are scalars."""
        return self.form.tree(self.values)

    def replaced(self, changes: Mapping[str, Any]) -> "Parameters":
        """The parameters with replacements, by name; a name such as `"system.modes[*].drag"` replaces several."""
        values = tuple(
            changes.get(name, changes.get(of_all_modes(name), value))
            for name, value in zip(self.names, self.values, strict=True)
        )
        return dataclasses.replace(self, values=values)

    def value(self, name: str) -> Array:
        """The value of a parameter; of the first of several."""
        return next(leaf for own, leaf in zip(self.names, self.values, strict=True) if name in (own, of_all_modes(own)))

    @property
    def known(self) -> list[str]:
        """The names of the numbers that can be varied, the floats, one by one or in all modes that have them."""
        floats = [name for name, value in zip(self.names, self.values, strict=True) if eqx.is_inexact_array(value)]
        merged_names = [of_all_modes(name) for name in floats]
        return [*floats, *dict.fromkeys(name for name in merged_names if merged_names.count(name) > 1)]

    def full_name(self, argument: str, name: str) -> str:
        """The full name for a name, as in `nonholonomic.parameters.full_name`.

        **Raises:** `ValueError` for an unknown or ambiguous name, with a hint for an attribute that is no float.
        """
        try:
            return full_name(argument, name, self.known)
        except ValueError as error:
            message, end = str(error), name.rsplit(".", 1)[-1]
        # The name may be that of an integer, or of an attribute that has no type in its class.
        for module in _modules(self.tree):
            value = getattr(module, end, None)
            if isinstance(value, int | float) and not isinstance(value, bool):
                if end not in {field.name for field in dataclasses.fields(module)}:
                    message += f"; declare it with its type in {type(module).__name__}: {end}: float = {float(value)}"
                elif isinstance(value, int):
                    message += f"; {end} = {value} is an integer: write {float(value)}"
                break
        raise ValueError(message)


def of_all_modes(name: str) -> str:
    """The name of a number for all modes that have it."""
    return re.sub(r"\bmodes\[\d+\]", "modes[*]", name)


def require_apart(argument: str, names: Iterable[str]) -> None:
    """Raise `ValueError` if a number is named both alone and for all modes."""
    for name in names:
        if name != of_all_modes(name) in names:
            raise ValueError(f"{argument}: {name!r} is named twice, alone and for all modes")


def short_names(names: list[str]) -> dict[str, str]:
    """For each full name, the part after its last dot, in the form `start_0`; if several names end alike, the whole
    name."""
    table = str.maketrans({"[": "_", "]": None, ".": "_"})
    ends = [name.rpartition(".")[2] for name in names]
    plain, ends = ([text.replace("[*]", "").translate(table) for text in texts] for texts in (names, ends))
    return {name: end if ends.count(end) == 1 else text for name, text, end in zip(names, plain, ends, strict=True)}


def checks_of(tree: PyTree) -> list[tuple[eqx.Module, type]]:
    """The modules of a tree that check their numbers when they are created, each with every class that declares a check."""
    modules = ((module, kind) for module in _modules(tree) for kind in type(module).__mro__)
    return [(module, kind) for module, kind in modules if "__check_init__" in vars(kind)]


def _modules(tree: PyTree) -> Iterator[eqx.Module]:
    inner = jax.tree.leaves(tree, is_leaf=lambda node: isinstance(node, eqx.Module) and node is not tree)
    if isinstance(tree, eqx.Module):
        yield tree
    for node in inner:
        if isinstance(node, eqx.Module) and node is not tree:
            yield from _modules(node)
