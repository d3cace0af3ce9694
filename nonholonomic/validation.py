"""Checks of arguments, whose messages name the argument, its value and what is allowed; and warnings.

Traced numbers pass these checks. A module states the ranges of its numbers once, in `bounds`: concrete numbers out of
range raise an error; traced numbers out of range make `legal` false and the results NaN.
"""

import contextlib
import dataclasses
import functools
import inspect
import math
import operator
import os
import sys
import tempfile
import uuid
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeAlias, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from .text import as_html, contents, is_users, likely, likely_fix, one_line, readable_unit, shown

# Warnings, which point to the user's line.

#: Packages whose lines a warning does not point to: ours, and those through which our functions are called.
NO_CODE_OF_A_USER = ("nonholonomic", "tippe", "stroller", "equinox", "jax", "jaxtyping", "beartype", "typeguard")
NO_CODE_OF_A_USER += ("contextlib", "dataclasses", "functools", "importlib", "concurrent", "threading")


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn at the user's line that led here, so that Python shows the warning once for each such line."""
    frame = _users_frame()
    if frame is None:
        # In a thread that we have started: its first line.
        frame = sys._getframe(1)
        while frame.f_back is not None:
            frame = frame.f_back
    registry = frame.f_globals.setdefault("__warningregistry__", {})
    place = (frame.f_code.co_filename, frame.f_lineno, frame.f_globals.get("__name__"))
    warnings.warn_explicit(message, category, *place, registry)


def _users_frame() -> FrameType | None:
    """The innermost frame of a user's code."""
    frame: FrameType | None = sys._getframe(2)
    while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] in NO_CODE_OF_A_USER:
        frame = frame.f_back
    return frame


#: Addition to the message about an angle that may be in degrees.
IN_DEGREES = "; angles are in radians: did you mean np.radians({})?"

#: How a number is compared with its bounds `above`, `at_least`, `below` and `at_most`, and in words.
COMPARISONS = (
    (operator.gt, "greater than"),
    (operator.ge, "at least"),
    (operator.lt, "less than"),
    (operator.le, "at most"),
)

#: What a message says about a user's function after `jax.errors.JAXTypeError`.
UNTRACEABLE = (
    "cannot be traced by JAX: write it with jax.numpy in place of numpy and math, and with jnp.where in place of `if`"
)


#: A number or numbers with which others are compared, or `None`.
Limit = Any

#: Numbers as users write them: a number, an array, or a list of numbers or of rows.
ArrayOrList: TypeAlias = ArrayLike | Sequence[float] | Sequence[Sequence[float]]

#: An array, or something else that `require` will reject.
if TYPE_CHECKING:
    Converted: TypeAlias = Float[Array, "..."]
else:
    Converted = object


def as_number(value: object) -> Converted:
    """Convert to a floating-point array of the default precision; anything that is not a number stays unchanged, for
    `require` to reject, or because it is an omitted number, `None`."""
    try:
        # NumPy would read numbers from texts.
        for leaf in jax.tree.leaves(value):
            if isinstance(leaf, str | bytes) or (isinstance(leaf, np.ndarray) and leaf.dtype.kind in "SU"):
                raise TypeError
        return jnp.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return value  # pyright: ignore[reportReturnType]


def as_known(value: object) -> Converted:
    """Like `as_number`, but a concrete number stays concrete inside a transformation, where `jax.jit` would trace an
    array."""
    if is_traced(value):
        return as_number(value)
    with jax.ensure_compile_time_eval():
        return as_number(value)


def is_traced(value: PyTree) -> bool:
    """Whether the value, or a leaf of it, is known only while JAX runs a transformation."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


def largest(*values: PyTree) -> float:
    """The largest magnitude among concrete finite numbers; 0 without any. For `Bounded.suspicion`."""
    leaves = jax.tree.leaves(values)
    arrays = [np.abs(np.asarray(leaf)) for leaf in leaves if isinstance(leaf, jax.Array) and not is_traced(leaf)]
    return max((float(np.max(array)) for array in arrays if array.size and np.isfinite(array).all()), default=0.0)


def _first(numbers: np.ndarray, holds: np.ndarray | np.bool_) -> str:
    """The first number for which the condition is false."""
    return shown(numbers[~holds].ravel()[0]) if numbers.ndim else shown(numbers)


def require(value: object, name: str, **limits: Limit) -> None:
    """Raise `ValueError` unless every number in `value` is finite and within its limits; arguments as for `Bound`."""
    Bound(value, name, **limits).require()


def require_scalars(values: Mapping[str, Any], otherwise: str) -> None:
    """Raise `ValueError` unless each named value is a single number or omitted; `otherwise` is the advice for lists."""
    for name, value in values.items():
        if value is not None and np.ndim(value) != 0:
            raise ValueError(f"{name} must be one number, not of shape {np.shape(value)}; {otherwise}")


#: What a value must be.
Kind = TypeVar("Kind")


def require_kind(value: object, name: str, kind: type[Kind], example: str = "", several: str = "") -> Kind:
    """Return a value of the given kind, such as a `Scene`; raise `ValueError` for anything else.

    If the value is a module of the same name from another package, such as a stroller's scene for a top, the message
    names both packages. For a list of values of the kind, the message says what accepts `several`. Otherwise it ends in
    the `example`.
    """
    if isinstance(value, kind):
        return value
    kind_name = kind.__name__.removeprefix("Abstract")
    if isinstance(value, list | tuple) and value and all(isinstance(part, kind) for part in value):
        raise ValueError(
            f"{name} must be one {kind_name}, not a list of {len(value)}" + (f"; {several}" if several else "")
        )
    if type(value).__name__ == kind_name:
        package_of_value, package_of_kind = (owner.__module__.partition(".")[0] for owner in (type(value), kind))
        raise ValueError(
            f"{name} is a {package_of_value}.{kind_name} and must be a {package_of_kind}.{kind_name}: each package has its own"
        )
    raise ValueError(f"{name} = {shown(value)} must be a {kind_name}{example}{likely_fix(value, kind_name)}")


def require_one_run(run: Any, action: str, many: str) -> None:
    """Raise `ValueError` for a batch of runs. **Arguments:** `action`: what takes a single run; `many`: what accepts
    several runs."""
    if np.ndim(run.t) != 1:
        raise ValueError(
            f"this is a batch of runs, with t of shape {np.shape(run.t)}, and {action} takes one run: select one by "
            f"jax.tree.map(lambda leaf: leaf[0], runs){many}"
        )


def require_outside(values: PyTree, caller: str, instead: str) -> None:
    """Raise `ValueError` inside `jit`, `vmap` and `grad` for functions that run on the host only.

    **Arguments:** `values`: the arguments to check; `caller`: the function; `instead`: what to use inside
    transformations.
    """
    # Inside `jit`, a new array is traced even if all its numbers are known.
    if is_traced((as_number(0.0), values)):
        raise ValueError(f"{caller} cannot be called inside jit, vmap or grad: use {instead} there")


def require_whole(value: object, name: str, at_least: int) -> None:
    """Raise `ValueError` unless the value is a whole number of at least `at_least`."""
    if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < at_least:
        raise ValueError(f"{name} = {shown(value)} must be a whole number of at least {at_least}")


def require_increasing(values: Any, name: str) -> None:
    """Raise `ValueError` unless the values are a non-empty list, each greater than the one before.

    **Arguments:** `values`: numbers; traced lists pass; `name`: name in the message.
    """
    if np.ndim(values) != 1 or np.shape(values)[0] == 0:
        raise ValueError(
            f"{name} = {shown(values)} must be a list of at least one number, not of shape {np.shape(values)}"
        )
    if is_traced(values):
        return
    numbers = np.asarray(values)
    positions = np.flatnonzero(~(np.diff(numbers) > 0.0))
    if positions.size:
        k = int(positions[0]) + 1
        raise ValueError(
            f"{name}[{k}] = {shown(numbers[k])} must be greater than {name}[{k - 1}] = {shown(numbers[k - 1])}: "
            f"{name} must increase"
        )


def times_within(times: ArrayOrList, end: ArrayLike, run: str) -> Float[np.ndarray, " times"]:
    """Convert times of output, or one time, to a list; raise `ValueError` unless they increase and lie within [0, `end`].
    **Arguments:** `end`: end of the run [s]; `run`: the word for the run in the message."""
    require(times, "times", at_least=0.0, at_most=end, why=f"the {run} ends there")
    times = np.atleast_1d(np.asarray(times, dtype=float))
    require_increasing(times, "times")
    return times


def require_flag(value: object, name: str) -> None:
    """Raise `ValueError` unless the value is true or false; a word such as "no" would count as true."""
    if not isinstance(value, bool | np.bool_):
        raise ValueError(f"{name} = {shown(value)} must be True or False")


def require_folder(path: Path, name: str) -> None:
    """Create a folder if necessary, and raise `OSError` unless files can be written in it."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise OSError(f"{name} = {path}: nothing can be written there: {error.strerror}") from None


def as_path(path: object, name: str) -> Path:
    """Convert to a path; raise `ValueError` for a value that is not a path."""
    if isinstance(path, str | os.PathLike) and path != "" and "\0" not in str(path):
        with contextlib.suppress(TypeError):
            return Path(path)
    raise ValueError(f"{name} = {shown(path)} must be the path of a file")


def require_file(path: object, name: str, *endings: str) -> Path:
    """Raise `ValueError` unless a path has one of the endings, and `OSError` unless a file can be written there.

    **Returns:** the path.
    """
    file = as_path(path, name)
    if file.suffix not in endings:
        raise ValueError(f"{name} = {str(path)!r} must end in {' or '.join(endings)}")
    if file.is_dir():
        raise OSError(f"{name} = {file}: it is a folder")
    try:
        with tempfile.TemporaryFile(dir=file.parent):
            pass
    except OSError as error:
        raise OSError(f"{name} = {file}: nothing can be written there: {error.strerror}") from None
    return file


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new file that replaces `path` at the end of the context, completely or not at all. If `path` is a symbolic link,
    the new file replaces the file to which it points.

    **Raises:** `OSError` that names the path if it cannot be written.
    """
    target = real_path(path)
    # The ending tells the kind of a file to its writer.
    scratch = target.parent / f"{path.name}.{uuid.uuid4().hex}.part{path.suffix}"
    try:
        if target.is_dir():
            raise OSError(0, "it is a folder")
        scratch.touch(exist_ok=False)
        yield scratch
        with scratch.open("r+b") as stream:
            os.fsync(stream.fileno())
        os.replace(scratch, target)
        sync_folder(target.parent)
    except BaseException as error:
        with contextlib.suppress(OSError):
            scratch.unlink()
        # Errors that were raised while reading the chunks keep their own message.
        if isinstance(error, OSError) and error.strerror:
            raise OSError(f"cannot write {path}: {error.strerror}") from None
        raise


def real_path(path: Path) -> Path:
    """The file to which a symbolic link points; any other path itself."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries to disk, on systems that let a folder be opened."""
    if os.name == "posix":
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def require_package(name: str, extra: str, purpose: str) -> None:
    """Raise `ModuleNotFoundError` unless an optional package is installed. Call this before the work begins.

    **Arguments:** `name`: name of the package; `extra`: the extra of this distribution that installs it; `purpose`:
    what needs it.
    """
    if find_spec(name) is None:
        raise ModuleNotFoundError(f"{purpose} needs {name}: pip install 'nonholonomic[{extra}]'", name=name)


class Usual(NamedTuple):
    """The greatest usual magnitude of a number, and other units, with their sizes in its own, in which a greater one may have
    been given; in radians, such a number may be in degrees, and certainly is beyond `turns`."""

    most: float
    others: Mapping[str, float] = MappingProxyType({})
    turns: float = math.inf

    def question(self, name: str, value: object, unit: str) -> str | None:
        """A question for a concrete number that is greater; `None` for any other."""
        if (number := largest(value)) <= self.most:
            return None
        unit, degrees = f" {readable_unit(unit)}".rstrip(), IN_DEGREES.format(f"{number:g}")
        if number > 2.0 * math.pi * self.turns:
            raise ValueError(f"{name} = {shown(value)} must be within [-2 pi, 2 pi]{degrees}")
        large = f"{name} = {number:.4g}{unit} is large"
        if not self.others:
            # Whole tenths of a degree, such as pi / 2, were converted.
            tenths = 10.0 * math.degrees(number)
            return None if math.isclose(tenths, round(tenths), rel_tol=1e-12) else large + degrees
        words = ", ".join(f"{number:.4g} {other} are {size * number:.4g}{unit}" for other, size in self.others.items())
        return f"{large}: was it in {' or '.join(self.others)}? {words}"


class Bound(NamedTuple):
    """The range in which a number is legal.

    - `value`: a number or an array of numbers; a traced value or traced limits pass unchecked.
    - `name`: name in the message.
    - `above`, `at_least`, `below`, `at_most`: limits, each a number.
    - `why`: a remark to append to the message.
    - `unit`: "rad" for an angle, so that the message asks whether a number above its limits is in degrees.
    """

    # Ranges of a number as the metadata of its field.
    POSITIVE = {"range": {"above": 0.0}}  # noqa: RUF012
    NOT_NEGATIVE = {"range": {"at_least": 0.0}}  # noqa: RUF012
    # An acceleration of free fall [m/s^2] that is greater than on any planet is suspicious.
    GRAVITY = POSITIVE | {"usual": Usual(100.0, {"cm/s²": 0.01})}

    value: Any
    name: str
    above: Limit = None
    at_least: Limit = None
    below: Limit = None
    at_most: Limit = None
    why: str = ""
    unit: str = ""

    @property
    def limits(self) -> list[tuple[Limit, Callable[..., Any], str]]:
        """The limits that there are, how a number is compared with each, and in words."""
        comparisons = zip((self.above, self.at_least, self.below, self.at_most), COMPARISONS, strict=True)
        return [(limit, *comparison) for limit, comparison in comparisons if limit is not None]

    def require(self) -> None:
        """Raise `ValueError` unless every number is legal or traced."""
        value, name = self.value, self.name
        if is_traced(value):
            return
        # NumPy would convert these to numbers.
        if value is None or isinstance(value, str | bytes):
            hint = ""
            with contextlib.suppress(ValueError):
                hint = f": did you mean {float(str(value).replace(',', '.')):g}?"
            raise ValueError(f"{name} = {shown(value)} is not a number{hint}")
        # JAX transformations rebuild pytrees with placeholders, but constructors must not receive any.
        try:
            numbers = np.asarray(value)
            if numbers.dtype.kind in "US":
                raise TypeError
            numbers = numbers.astype(float)
        except (TypeError, ValueError):
            raise ValueError(f"{name} = {shown(value)} is not a number, or a list of numbers") from None
        except OverflowError:
            raise ValueError(f"{name} is an integer beyond 1.8e308 and must be finite") from None
        remark = f" ({self.why})" if self.why else ""
        finite = np.isfinite(numbers)
        if not np.all(finite):
            raise ValueError(f"{name} = {_first(numbers, finite)} must be finite{remark}")
        for limit, holds, words in self.limits:
            if is_traced(limit):
                continue
            numbers, limits = np.broadcast_arrays(numbers, np.asarray(limit, dtype=float))
            allowed = holds(numbers, limits)
            if not np.all(allowed):
                number = _first(numbers, allowed)
                degrees = IN_DEGREES.format(number) if self.unit == "rad" and limit is self.at_most else ""
                limit_in_words = _first(limits, allowed).replace(str(np.pi), "pi rad")
                raise ValueError(f"{name} = {number} must be {words} {limit_in_words}{remark}{degrees}")

    @property
    def holds(self) -> Bool[Array, "..."]:
        """Whether the number is legal, as an array of the program."""
        conditions = [holds(self.value, limit) for limit, holds, _ in self.limits]
        return functools.reduce(jnp.logical_and, conditions, jnp.isfinite(self.value))


Function = TypeVar("Function", bound=Callable[..., object])


def explaining(function: Function, advice: Mapping[str, str] = MappingProxyType({})) -> Function:
    """Let a function, or a class method that constructs an object, name its arguments where it is called with others, and
    add advice: its own, or that of the class."""
    of_class = "." in function.__qualname__

    @functools.wraps(function)
    def explained(*values: Any, **named: object) -> object:
        try:
            return function(*values, **named)
        except TypeError:
            owner, *arguments = values if of_class else (function, *values)
            is_method = of_class and function.__name__ != "__call__"
            called = getattr(owner, function.__name__) if is_method else owner
            signature = inspect.signature(called)
            try:
                signature.bind(*arguments, **named)
            except TypeError as error:
                known = signature.parameters
                takes_all = any(parameter.kind is parameter.VAR_KEYWORD for parameter in known.values())
                unknown = [name for name in named if name not in known and not takes_all]
                wrong = [f"{name} = {shown(named[name])} is not among them{likely(name, known)}" for name in unknown]
                advised = getattr(owner, "advice", advice)
                remarks = [advised[name] for name in advised if name in unknown or f"'{name}'" in str(error)]
                words = [*(wrong or [str(error)]), *dict.fromkeys(remarks)]
                raise TypeError(f"{shown(called)} takes {', '.join(known)}; {'; '.join(words)}") from None
            raise

    return explained  # pyright: ignore[reportReturnType]


#: The metaclass of `Bounded`. For type checkers it is that of `eqx.Module`, whose constructors they know.
Explaining: Any = type("Explaining", (type(eqx.Module),), {"__call__": explaining(type(eqx.Module).__call__)})


def _parts(name: str, value: object) -> dict[str, object]:
    """The numbers of a field by their names: one number, or those of a tuple."""
    return {f"{name}[{k}]": part for k, part in enumerate(value)} if isinstance(value, tuple) else {name: value}


class Bounded(eqx.Module, metaclass=Explaining):
    """A module whose numbers have ranges and units; concrete numbers out of range raise an error."""

    #: The units of the module's own numbers, by name.
    units: ClassVar[dict[str, str]] = {}

    #: What to do about an argument that is missing, or that the constructor does not have, by name.
    advice: ClassVar[dict[str, str]] = {}

    def bounds(self) -> Iterator[Bound]:
        """The ranges of the module's own numbers, in the order in which they are to be checked: those that the fields
        declare as metadata, such as `Bound.POSITIVE`; any other number with a unit must be finite, unless it is omitted. A
        class adds the ranges that depend on its other numbers.

        This is a generator, so that a range computed from another number is computed only after that number has been
        checked.
        """
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            limits = field.metadata.get("range", {} if field.name in self.units else None)
            is_omitted = value is None and field.default is None
            if limits is not None and not is_omitted:
                for name, part in _parts(field.name, value).items():
                    yield Bound(**({"value": part, "name": name} | limits))

    def suspicion(self) -> str | None:
        """A possible mistake in legal numbers as text, such as another unit by the `Usual` of a field; `None` if there is
        none."""
        fields = (field for field in dataclasses.fields(self) if "usual" in field.metadata)
        questions = (
            field.metadata["usual"].question(field.name, getattr(self, field.name), self.units[field.name])
            for field in fields
        )
        return next(filter(None, questions), None)

    def __check_init__(self):
        # The module's own numbers are scalars or lists of one length; the arrays of a user's class may have any shapes.
        arrays = {}
        for field in dataclasses.fields(self) if not is_users(type(self)) else ():
            for name, part in _parts(field.name, getattr(self, field.name)).items():
                if isinstance(part, jax.Array | np.ndarray):
                    arrays[name] = part
                    if 0 in np.shape(part):
                        raise ValueError(f"{name} = [] must be a number, not an empty list")
        try:
            np.broadcast_shapes(*map(np.shape, arrays.values()))
        except ValueError:
            arrays = {name: part for name, part in arrays.items() if np.ndim(part)}
            lists = ", ".join(f"{name} of shape {np.shape(part)}" for name, part in arrays.items())
            raise ValueError(
                f"{type(self).__name__}: {lists}: the numbers of one object must be scalars or lists of equal length; for a "
                f"table of all combinations, leave single numbers here and pass it axes={shown(arrays)}, in SI units"
            ) from None
        require_all(self.bounds())
        # Copies that our threads make of the user's modules repeat no warning.
        if (suspicion := self.suspicion()) is not None and _users_frame() is not None:
            warn(suspicion)

    @property
    def _has_units(self) -> bool:
        """Whether the numbers have their units: a gradient, whose numbers may be out of range, has others."""
        with contextlib.suppress(ValueError):
            require_all(all_bounds(self))
            return True
        return False

    def __repr__(self) -> str:
        return one_line(self, self._has_units)

    def __str__(self) -> str:
        if not any(isinstance(getattr(self, field.name, None), eqx.Module) for field in dataclasses.fields(self)):
            return repr(self)
        rows = contents(self, self._has_units)
        width = max(len(name) for name, _ in rows)
        return "\n".join([type(self).__name__, *(f"  {name:{width}}  {text}" for name, text in rows)])

    def _repr_html_(self) -> str:
        return as_html(type(self).__name__, contents(self, self._has_units))


def require_all(bounds: Iterable[Bound]) -> None:
    """Raise `ValueError` for the first number that is neither legal nor traced."""
    for bound in bounds:
        bound.require()


def all_bounds(module: object) -> Iterator[Bound]:
    """The ranges of the numbers of a module and its submodules; none for a module that is not `Bounded`."""
    if isinstance(module, Bounded):
        yield from module.bounds()
        for field in dataclasses.fields(module):
            yield from all_bounds(getattr(module, field.name))


def legal(bounds: Iterable[Bound]) -> Bool[Array, "..."]:
    """Whether all numbers are within their ranges; for traced numbers, which `require` cannot check.

    Numbers of different shapes are broadcast: one for all cells, or one per cell.
    """
    return functools.reduce(jnp.logical_and, (bound.holds for bound in bounds), jnp.asarray(True))


def nan_unless(holds: Bool[Array, "..."], tree: PyTree) -> PyTree:
    """The tree with every floating-point number, and every derivative through it, NaN unless `holds`."""
    # Multiply instead of selecting: the derivative of a value that was not selected would be 0.
    factor = jnp.where(holds, 1.0, jnp.nan)
    return jax.tree.map(lambda leaf: leaf * factor if eqx.is_inexact_array(leaf) else leaf, tree)
