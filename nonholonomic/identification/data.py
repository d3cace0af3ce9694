"""Fit several sets of data together: join measurements, and name the parameters that are shared or belong to a single
set."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int

from ..parameters import full_name
from .likelihood import Measurements, joined_measurements
from .unknown import Free, as_free

#: Stands for every set of data that has the parameter.
EACH = "data[*]."


def joined_data(data: tuple[Any, ...]) -> tuple[Measurements, tuple[str, ...], Int[np.ndarray, " n"]]:
    """The joined measurements of several sets of data, their labels, and the indices of the predictions that were measured.

    **Arguments:** `data`: sets of data, each with the attributes `measurements`, `labels`, `seen`, and `size` (the
    number of its predictions).
    """
    labels = numbered([source.labels for source in data])
    offsets = np.cumsum([0, *(source.size for source in data)])
    indices = np.concatenate([first + source.seen for first, source in zip(offsets, data, strict=False)])
    return joined_measurements([source.measurements for source in data]), labels, indices


def numbered(labels: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """The labels of all sets of data, with the number of the set if there are several."""
    several = len(labels) > 1
    return tuple(f"{k}: {label}" if several else label for k, part in enumerate(labels, 1) for label in part)


def of_data(parameters: dict[str, Any], k: int) -> dict[str, Any]:
    """The parameters of one set of data: the shared parameters, and its own parameters without the prefix `data[k].`."""
    prefix = f"data[{k}]."
    shared = {name: value for name, value in parameters.items() if not name.startswith("data[")}
    parameters_of_data = {
        name.removeprefix(prefix): value for name, value in parameters.items() if name.startswith(prefix)
    }
    return shared | parameters_of_data


def own_name(name: str) -> str:
    """The name of a parameter without the prefix `data[k].`."""
    return name.split(".", 1)[1] if name.startswith("data[") else name


def free_numbers(
    free: Any, shared: list[str], own: list[list[str]], check: Callable[[dict[str, float]], Any]
) -> dict[str, Free]:
    """The unknowns of a scene and its data: their full names, and a lower bound of 0 for parameters that cannot be negative.

    **Arguments:**

    - `free`: name, or its unambiguous end, -> a `Free` or a start value. `data[1].launch.azimuth` is a parameter of the
      second set of data alone, and `data[*].launch.azimuth` stands for one parameter of each set.
    - `shared`: full names of the parameters of the model; `own`: names of the parameters of each set of data, without
      the prefix. A name of `own` without a prefix is shared, too.
    - `check`: function of a dictionary (name without prefix -> number) that raises `ValueError` for illegal values.

    **Returns:** full name -> `Free`.

    **Raises:** `ValueError` for an unknown name or illegal start values.
    """
    candidates = [*shared, *dict.fromkeys(itertools.chain(*own))]
    unknowns: dict[str, Free] = {}
    for name_or_suffix, unknown in as_free(free).items():
        for name in _full_names(name_or_suffix, candidates, own):
            if name in unknowns:
                raise ValueError(f"free: {name!r} is named twice")
            unknowns[name] = unknown
    for name in unknowns:
        if own_name(name) != name and own_name(name) in unknowns:
            raise ValueError(f"free: {name!r} is named twice, alone and for all data")
    for k in range(len(own)):
        check({name: unknown.start for name, unknown in of_data(unknowns, k).items()})
    lower = {}
    for name, unknown in unknowns.items():
        try:
            check({own_name(name): -(abs(unknown.start) or 1.0)})
        except ValueError:
            lower[name] = 0.0
    return as_free(unknowns, lower)


def _full_names(name_or_suffix: str, candidates: list[str], names_of_data: list[list[str]]) -> list[str]:
    """The full names that a name matches."""
    if not str(name_or_suffix).startswith("data["):
        return [full_name("free", name_or_suffix, candidates)]
    if name_or_suffix.startswith(EACH):
        all_names = list(dict.fromkeys(name for names in names_of_data for name in names))
        name = full_name("free", name_or_suffix.removeprefix(EACH), all_names)
        return [f"data[{k}].{name}" for k, names in enumerate(names_of_data) if name in names]
    all_names = [f"data[{k}].{name}" for k, names in enumerate(names_of_data) for name in names]
    return [full_name("free", name_or_suffix, all_names)]
