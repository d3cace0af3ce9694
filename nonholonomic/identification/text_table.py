"""A text file of columns with a header line, read in the units of the file."""

import csv
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..text import UNITS, likely
from ..validation import require, shown

#: Hyphens and dashes in place of a number.
DASHES = ("-", "--", "\u2013", "\u2014")

#: Cells, in lower case, that stand for a missing sample.
MISSING = ("", "nan", "n/a", "#n/a", "na", "null", "none", *DASHES)

#: Other words for units in headers.
SYNONYMS = {"°": "deg", "degree": "deg", "degrees": "deg", "°/s": "deg/s", "radian": "rad", "radians": "rad"}
SYNONYMS |= {"sec": "s", "second": "s", "seconds": "s", "1/min": "rpm", "rev/min": "rpm", "U/min": "rpm"}


class TextTable(NamedTuple):
    """The cells of a file as text: header -> cells; the number of each row's line in the file; the decimal mark; and the
    headers that the file has more than once."""

    path: Path
    cells: dict[str, list[str]]
    lines: list[int]
    decimal: str
    repeated: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path, decimal: str) -> "TextTable":
        """Read a file of columns."""
        text = [(number, line) for number, line in enumerate(_text(path).splitlines(), start=1) if _has_cells(line)]
        if len(text) < 2:
            raise ValueError(f"path = {str(path)!r} must have a header line and at least one line of numbers")
        marks = ("\t", ";") if decimal == "," else ("\t", ";", ",")
        mark = next((mark for mark in marks if mark in text[0][1]), None)
        if mark is None and decimal == "," and "," in text[0][1]:
            raise ValueError(
                f"path = {str(path)!r}: the header separates columns by commas, so decimal must be '.': separate the columns "
                "by semicolons"
            )
        # Blanks also stand between a name and its unit, as in "theta [deg]".
        part = re.compile(r"\S+(?:\s+[\[(][^\])]*[\])])?")
        try:
            rows = [next(csv.reader([line], delimiter=mark)) if mark else part.findall(line) for _, line in text]
        except csv.Error as error:
            raise ValueError(f"path = {str(path)!r} is not a text file of columns: {error}") from None
        headers = [header.strip() for header in rows[0]]
        for (number, _), row in zip(text, rows, strict=True):
            if len(row) != len(headers):
                comma = mark == "," and len(row) > len(headers)
                hint = (
                    "; to read decimal commas, separate the columns by semicolons and pass decimal=','" if comma else ""
                )
                raise ValueError(f"path = {str(path)!r}: line {number} has {len(row)} cells, not {len(headers)}{hint}")
        cells = {header: [row[k].strip() for row in rows[1:]] for k, header in enumerate(headers)}
        repeated = tuple(header for header in cells if headers.count(header) > 1)
        return cls(path, cells, [number for number, _ in text[1:]], decimal, repeated)

    def named(self, known: Mapping[str, str]) -> dict[str, Any]:
        """The columns whose headers are names of the model's columns, with their headers."""
        columns = {}
        for header in self.cells:
            name, unit = _split(header)
            if name.lower() in known:
                if name.lower() in columns:
                    raise self._ambiguous("columns", name.lower(), [columns[name.lower()], header])
                columns[name.lower()] = header if unit else (header, _unit_of(name.lower(), known))
        if not columns.keys() - {"time", "frame"}:
            raise ValueError(
                f"path = {str(self.path)!r}: no header is the name of a quantity with its unit, such as 'theta [deg]': pass "
                f"columns, a dictionary; the headers are {', '.join(self.cells)}"
            )
        return columns

    def numbers(
        self,
        name: str,
        header_and_unit: Any,
        si: str,
        argument: str = "columns",
        remark: str = "",
        infinite: bool = False,
    ) -> np.ndarray:
        """A column in SI units, NaN where it is missing. **Arguments:** `argument`: as for `parts`; `remark`: an addition to
        the message about a cell that is not a number; `infinite`: whether numbers may be infinite."""
        header, size = self.parts(name, header_and_unit, si, argument)
        numbers = zip(self.lines, self.cells[header], strict=True)
        return size * np.array([self._number(header, line, cell, remark, infinite) for line, cell in numbers])

    def errors(self, name: str, header_and_unit: Any, si: str) -> np.ndarray:
        """The standard errors of a column in SI units, from a column of their own or the same in all lines."""
        header, size = self.parts(name, header_and_unit, si, "error")
        if isinstance(header, str):
            return self.numbers(name, header_and_unit, si, "error")
        require(header, f"error of {name}", above=0.0)
        return np.full(len(self.lines), size * float(header))

    def _number(self, header: str, line: int, cell: str, remark: str, infinite: bool) -> float:
        if cell.lower() in MISSING:
            return math.nan
        place = f"{header} = {cell!r} in line {line} of {str(self.path)!r}"
        if self.decimal == "," and "." in cell:
            raise ValueError(
                f"{place} has a decimal point, or a mark of thousands, although decimal = ',': remove marks of thousands from "
                "the file; if its numbers have decimal points, leave out decimal"
            )
        try:
            # Python also reads 1_000.
            number = float("_" if "_" in cell else cell.replace(",", ".") if self.decimal == "," else cell)
        except ValueError:
            hint = ": pass decimal=',' if it has a decimal comma" if "," in cell and self.decimal == "." else remark
            raise ValueError(f"{place} is not a number{hint}") from None
        if math.isinf(number) and not infinite:
            raise ValueError(f"{place} must be finite: write n/a, or nothing, for a missing sample")
        return number

    def parts(self, name: str, header_and_unit: Any, si: str, argument: str) -> tuple[Any, float]:
        """The header of a column (or, for an error, possibly a number), and the factor that converts the file's numbers to
        SI units.

        **Arguments:** `name`: name of the column of the model; `header_and_unit`: (header, unit), or a header with its
        unit; `si`: the SI unit; `argument`: "columns" or "error", for messages.
        """
        first, unit = header_and_unit if _is_pair(header_and_unit) else (header_and_unit, None)
        of_header = None
        if isinstance(first, str):
            first = self._header(argument, name, first)
            of_header = _split(first)[1] or None
        elif argument == "columns" or unit is None:
            first = unit = None
        unit = of_header if unit is None else unit
        if unit is None:
            raise ValueError(
                f"{argument}: {name!r} = {shown(header_and_unit)} must be {self._expected(argument, si, first)}"
            )
        if not isinstance(unit, str):
            require(unit, f"unit of {name}")
            return first, float(unit)
        factors, plain = UNITS[si], SYNONYMS.get(unit, unit)
        if plain not in factors:
            raise ValueError(f"unit of {name} = {shown(unit)} must be one of {', '.join(factors)}, or a number of {si}")
        if of_header is not None and SYNONYMS.get(of_header, of_header) != plain:
            raise ValueError(
                f"{argument}: {name!r} = {shown(header_and_unit)} contradicts the header {first!r}, whose unit is {of_header}, "
                f"not {unit}: pass the header alone, {name!r}: {first!r}; if the header is wrong, correct it or pass a "
                f"factor, the number of {si} in {unit}"
            )
        return first, factors[plain]

    def _header(self, argument: str, name: str, header: str) -> str:
        """The full header for a header, with or without its unit."""
        matches = [header] if header in self.cells else [full for full in self.cells if _split(full)[0] == header]
        if len(matches) > 1 or not set(self.repeated).isdisjoint(matches):
            raise self._ambiguous(argument, name, matches)
        if not matches:
            raise ValueError(
                f"{argument}: {name!r} = {shown(header)} must be one of the headers of {str(self.path)!r}: "
                f"{', '.join(self.cells)}{likely(header, [*self.cells, *(_split(full)[0] for full in self.cells)])}"
            )
        return matches[0]

    def _ambiguous(self, argument: str, name: str, headers: list[Any]) -> ValueError:
        """The error for a column that the file has more than once."""
        listed = " or ".join(shown(header) for header in (headers if len(headers) > 1 else 2 * headers))
        return ValueError(
            f"{argument}: {name!r} could be {listed}, columns of {str(self.path)!r}: rename one of them in the file, or pass "
            "the whole header if it differs from the other"
        )

    def _expected(self, argument: str, si: str, header: Any) -> str:
        """What describes a column or its errors, for messages."""
        unit = "deg" if si == "rad" else next(iter(UNITS[si]))
        if header is not None:
            return f"(header, unit), such as ({header!r}, {unit!r}), because the header has no unit that is known"
        if argument == "error":
            return f"(standard error, unit), such as (1.0, {unit!r}), or (header of a column of standard errors, unit)"
        return f"(header, unit), such as ('tilt', {unit!r}), or a header with its unit, such as 'tilt [{unit}]'"


def _is_pair(value: Any) -> bool:
    return isinstance(value, tuple | list) and len(value) == 2


def _text(path: Path) -> str:
    """The text of a file in UTF-8, or as spreadsheets write it: in UTF-16 with a mark, or in Windows' encoding."""
    raw = path.read_bytes()
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def _has_cells(line: str) -> bool:
    return bool(line.strip()) and not line.lstrip().startswith("#")


def _split(header: str) -> tuple[str, str]:
    """The name and the unit of a header, such as "tilt [deg]", "tilt (deg)" or "tilt / deg"; no unit if there is none."""
    match = re.fullmatch(r"(.+?)\s*(?:\[([^\]]+)\]|\(([^)]+)\)|\s/\s*(\S+))", header.strip())
    if match is None:
        return header.strip(), ""
    unit = next(part for part in match.groups()[1:] if part).strip()
    known = unit in SYNONYMS or any(unit in units for units in UNITS.values())
    return (match[1].strip(), unit) if known else (header.strip(), "")


def _unit_of(name: str, known: Mapping[str, str]) -> str:
    """The unit of a column whose header has none: only a number without a unit needs none."""
    if known[name] != "1":
        raise ValueError(
            f"columns: the header {name!r} must have a unit, such as '{name} [{known[name]}]'; or pass columns, a dictionary"
        )
    return "1"
