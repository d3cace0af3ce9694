"""A type checker for `pytest --jaxtyping-packages=nonholonomic,tippe,stroller,checking.check`."""

import os
import sys
from collections.abc import Callable
from functools import reduce, wraps
from operator import or_
from pathlib import Path
from types import FrameType, UnionType
from typing import Annotated, Self, Union, get_args, get_origin

from beartype import BeartypeConf, beartype
from beartype.roar import BeartypeCallHintParamViolation, BeartypeCallHintViolation
from beartype.vale import IsInstance

PACKAGES = ("nonholonomic", "tippe", "stroller")
TESTS = str(Path(__file__).parents[1])

#: Functions of the packages that pass the arguments of their callers on.
DECORATORS = ("explaining.<locals>.explained",)

#: The tests that have passed an illegal argument, as `PYTEST_CURRENT_TEST` names them.
lenient_tests: set[str | None] = set()


def check(function: Callable) -> Callable:
    """Decorate a function so that it raises an exception where an argument or the result contradicts its annotation.

    Tests of error messages pass illegal arguments on purpose. Such a call is allowed if it comes from a test, and nothing
    else is checked in this test from there on.
    """
    function.__annotations__ = {name: readable(hint) for name, hint in function.__annotations__.items()}
    checked_function = beartype(conf=BeartypeConf(is_pep484_tower=True))(function)

    @wraps(function)
    def check_call(*args, **kwargs):
        try:
            return checked_function(*args, **kwargs)
        except BeartypeCallHintViolation as violation:
            test = os.environ.get("PYTEST_CURRENT_TEST")
            if isinstance(violation, BeartypeCallHintParamViolation) and is_called_by_test(sys._getframe(1)):
                lenient_tests.add(test)
            if test not in lenient_tests:
                raise
            return function(*args, **kwargs)

    return check_call


def is_called_by_test(frame: FrameType | None) -> bool:
    """Whether a call comes from a test, perhaps through other libraries, and not from the packages themselves."""
    while frame is not None and not frame.f_code.co_filename.startswith(TESTS):
        is_package = frame.f_globals.get("__name__", "").partition(".")[0] in PACKAGES
        if is_package and frame.f_code.co_qualname not in DECORATORS:
            return False
        frame = frame.f_back
    return frame is not None


def readable(hint: object) -> object:
    """An annotation that beartype can read, without `Self`, and with only the kind of an object of the packages: named
    tuples may have type variables, and a stored table would be read from its file."""
    if hint is Self:
        return object
    origin, arguments = get_origin(hint), get_args(hint)
    kind = origin or hint
    if isinstance(kind, type) and kind.__module__.partition(".")[0] in PACKAGES:
        return Annotated[object, IsInstance[kind]]
    readable_arguments = tuple(map(readable, arguments))
    if readable_arguments == arguments:
        return hint
    return reduce(or_, readable_arguments) if origin in (Union, UnionType) else origin[readable_arguments]
