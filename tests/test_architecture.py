"""The rooms: which way their imports point, and what stays inside them."""

import ast
import importlib.metadata
import io
import re
import sys
import tokenize
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import api_pages
import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("nonholonomic", "tippe", "stroller")

#: A room of `nonholonomic` imports only from rooms further down; those of one height only if that closes no circle.
HEIGHT = {
    "compilation": -1,
    "geometry": 0,
    "integration": 0,
    "derivatives": 1,
    "hybrid": 2,
    "kernels": 3,
    "views": 4,
    "sweeps": 5,
    "identification": 6,
    "runs": 7,
    "systems": 8,
}

#: The same for the rooms of a vehicle.
VEHICLE_HEIGHT = {"model": 0, "modes": 1, "runs": 2, "planning": 3}

#: Lines of code, without blank lines, comments and docstrings, of the longest file.
MOST_LINES = 450
MOST_FILES_OUTSIDE = 6

#: The size of the three packages: it may shrink. Imports are a share of the lines of code.
MOST = {"files": 113, "lines": 25_796, "functions": 2592, "Any": 380, "imports": 0.0787}


class Arrow(NamedTuple):
    """One import: from a file to a module, and the names taken from it."""

    file: str
    module: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.file} imports {', '.join(self.names) or 'all'} from {self.module}"


def files(*folders: str) -> list[str]:
    return sorted(str(path.relative_to(ROOT)) for folder in folders for path in (ROOT / folder).rglob("*.py"))


def statements(node: ast.AST, asked: bool = False) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Every import below a node and whether it stands in a function; those for type checkers alone are left out."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import | ast.ImportFrom):
            yield child, asked
        elif not (isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test)):
            yield from statements(child, asked or isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef))


def arrows_of(file: str) -> Iterator[Arrow]:
    """The imports of this project's modules in a file; a module that is imported whole has no names."""
    folder = Path(file).parts[:-1]
    for node, _ in statements(ast.parse((ROOT / file).read_text())):
        if isinstance(node, ast.Import):
            targets = [(name.name, ()) for name in node.names]
        else:
            parents = folder[: len(folder) - node.level + 1] if node.level else ()
            module = ".".join([*parents, *([node.module] if node.module else [])])
            modules = [name.name for name in node.names if is_module(f"{module}.{name.name}")]
            targets = [(f"{module}.{name}", ()) for name in modules]
            imported_names = tuple(name.name for name in node.names if name.name not in modules)
            targets += [(module, imported_names)] if imported_names else []
        yield from (Arrow(file, module, names) for module, names in targets if module.split(".")[0] in PACKAGES)


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.with_suffix(".py").exists() or (path / "__init__.py").exists()


def room(name: str) -> str:
    """The room, `package/room`, of a file or a module; the package for what stands outside of rooms."""
    parts = name.removesuffix(".py").split("/") if "/" in name else name.split(".")
    if parts[0] == "tests" and parts[1] in PACKAGES and len(parts) > 3:
        parts = parts[1:]
    is_subpackage = len(parts) > 1 and (ROOT / parts[0] / parts[1] / "__init__.py").exists()
    return "/".join(parts[:2]) if is_subpackage else parts[0]


ARROWS = [arrow for file in files(*PACKAGES) for arrow in arrows_of(file)]
ALL_ARROWS = ARROWS + [arrow for file in files("tests", "benchmarks", "examples") for arrow in arrows_of(file)]


def allowed(arrow: Arrow) -> bool:
    """Whether an import inside the packages points the right way."""
    start, end = room(arrow.file), room(arrow.module)
    (package, _, start_room), (target, _, end_room) = start.partition("/"), end.partition("/")
    if target != package:
        return target == "nonholonomic"
    if start == end or arrow.file == f"{package}/__init__.py" or not end_room:
        return True
    if package != "nonholonomic":
        return VEHICLE_HEIGHT.get(end_room, -1) < VEHICLE_HEIGHT.get(start_room, len(VEHICLE_HEIGHT))
    if not start_room:
        # The lowest room is as low as the files that stand outside, except for what both command lines share.
        return HEIGHT[end_room] < 0 or arrow.file == "nonholonomic/command_line.py"
    return HEIGHT[end_room] < HEIGHT[start_room] or HEIGHT[end_room] == HEIGHT[start_room] == 0


def circle(edges: set[tuple[str, str]]) -> list[str]:
    """What is left when everything that imports nothing left is taken away again and again: circles and what needs them."""
    left = {end for edge in edges for end in edge}
    while free := {node for node in left if not any(start == node and end in left for start, end in edges)}:
        left -= free
    return sorted(left)


def test_the_reader_of_imports_sees_them():
    rooms = {(room(arrow.file), room(arrow.module)) for arrow in ARROWS}
    assert {("nonholonomic/derivatives", "nonholonomic/integration"), ("tippe", "nonholonomic/geometry")} <= rooms
    # This one stands in a function.
    assert Arrow("nonholonomic/command_line.py", "nonholonomic.compilation.xla_cpu", ("compile_quickly",)) in ARROWS
    assert circle({("a", "b"), ("b", "a"), ("b", "c")}) == ["a", "b"]


def test_every_room_has_its_height_and_says_what_it_is_for():
    rooms = [path.parent for package in PACKAGES for path in (ROOT / package).glob("*/__init__.py")]
    assert {path.name for path in rooms if path.parent.name == "nonholonomic"} == set(HEIGHT)
    assert [path for path in rooms if not ast.get_docstring(ast.parse((path / "__init__.py").read_text()))] == []


def test_imports_point_one_way():
    assert [str(arrow) for arrow in ARROWS if not allowed(arrow)] == []


def test_rooms_close_no_circle():
    edges = {(room(arrow.file), room(arrow.module)) for arrow in ARROWS}
    inner = {(start, end) for start, end in edges if start != end and "/" in start and "/" in end}
    assert circle(inner) == []


@pytest.mark.parametrize("package", PACKAGES)
def test_modules_close_no_circle(package):
    edges = {
        (arrow.file.removesuffix(".py").replace("/", "."), arrow.module)
        for arrow in ARROWS
        if arrow.file.startswith(package + "/") and not arrow.file.endswith("__init__.py")
    }
    assert circle(edges) == []


def test_only_the_command_line_uses_the_tables_of_the_paper():
    assert {arrow.file for arrow in ARROWS if arrow.module == "tippe.paper"} == {"tippe/__main__.py"}


def test_the_packages_do_not_use_the_modules_of_tests_and_benchmarks():
    """These modules are not installed."""
    assert {"euler_angles", "papers"} <= modules_beside_the_packages()
    assert not imported_from_outside(functions=True) & modules_beside_the_packages()


def test_private_modules_and_names_stay_in_their_rooms():
    def private(arrow: Arrow) -> bool:
        parts = [*arrow.module.split("."), *arrow.names]
        return any(part.startswith("_") and not part.endswith("__") for part in parts)

    assert [str(arrow) for arrow in ALL_ARROWS if private(arrow) and room(arrow.file) != room(arrow.module)] == []


def test_the_vehicles_and_own_systems_use_only_the_public_engine():
    """What they import from its rooms is on a page of the API, so that others can write models as fast as theirs."""
    public = {id(api_pages.resolve(name)) for page in api_pages.PAGES.values() for name in page.names}

    def is_private(name: str) -> bool:
        return name not in api_pages.CONSTANTS and id(api_pages.resolve(name)) not in public

    names_used = {
        f"{arrow.module}.{name}": str(arrow)
        for arrow in ARROWS
        if room(arrow.file).split("/")[0] in ("tippe", "stroller") or room(arrow.file) == "nonholonomic/systems"
        if arrow.module.startswith(api_pages.ENGINE_ROOMS)
        for name in arrow.names
    }
    assert {"nonholonomic.integration.AbstractProblem", "nonholonomic.hybrid.Transition"} <= set(names_used)
    assert [arrow for name, arrow in names_used.items() if is_private(name)] == []
    assert is_private("nonholonomic.integration.scheduler.LaneScheduler")


def imported_from_outside(functions: bool) -> set[str]:
    """Top-level names of the absolute imports of the packages, at once and, on request, inside functions."""
    imported = set()
    for file in files(*PACKAGES):
        for node, asked in statements(ast.parse((ROOT / file).read_text())):
            if isinstance(node, ast.Import) and asked <= functions:
                imported |= {name.name.split(".")[0] for name in node.names}
            elif isinstance(node, ast.ImportFrom) and asked <= functions and not node.level:
                imported.add(node.module.split(".")[0])
    return imported


def test_what_is_imported_at_once_is_required():
    """Extras may be imported inside functions only: without them the packages must load."""
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    packages = {re.split(r"[^\w-]", requirement)[0] for requirement in required}
    # JAX brings jaxlib along.
    packages |= {"jaxlib", *sys.stdlib_module_names, *PACKAGES}
    imported = imported_from_outside(functions=False)
    assert {"jax", "numpy"} <= imported
    assert imported - packages == set()


def lines_of_code(text: str) -> int:
    """The lines that hold code: without blank lines, comments and docstrings."""
    skipped = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in skipped:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines.difference_update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return len(lines)


def test_lines_of_code_leave_out_what_is_no_code():
    assert lines_of_code('"""A module."""\n\n# Why.\nx = [\n    1,\n]\n') == 3


def test_no_file_is_long():
    lengths = {file: lines_of_code((ROOT / file).read_text()) for file in files(*PACKAGES)}
    assert {file: length for file, length in lengths.items() if length > MOST_LINES} == {}


def size() -> dict[str, float]:
    """The measures of the three packages."""
    texts = [(ROOT / file).read_text() for file in files(*PACKAGES)]
    nodes = [node for text in texts for node in ast.walk(ast.parse(text))]
    lines = sum(map(lines_of_code, texts))
    imports = [node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)]
    return {
        "files": len(texts),
        "lines": lines,
        "functions": sum(isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) for node in nodes),
        "Any": sum(isinstance(node, ast.Name) and node.id == "Any" for node in nodes),
        "imports": sum((node.end_lineno or node.lineno) - node.lineno + 1 for node in imports) / lines,
    }


def test_the_packages_do_not_grow():
    measured = size()
    assert {name: value for name, value in measured.items() if value > MOST[name]} == {}


def test_few_files_stand_outside_of_the_rooms():
    assert len(list((ROOT / "nonholonomic").glob("*.py"))) <= MOST_FILES_OUTSIDE


def test_every_file_that_the_walk_names_exists():
    names = re.findall(
        r"`((?:tests|tippe|nonholonomic|stroller)/[\w/.]*)`",
        (ROOT / "docs" / "development" / "architecture.md").read_text(),
    )
    assert names
    assert [name for name in names if not (ROOT / name).exists()] == []


def modules_beside_the_packages() -> set[str]:
    """Top-level modules of the tests, benchmarks, reference scenes and documents."""
    folders = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]["pythonpath"]
    return {path.stem for folder in folders for path in (ROOT / folder).glob("[!_.]*") if path.suffix in ("", ".py")}


def test_no_module_beside_the_packages_has_the_name_of_an_installed_package():
    """Python finds a module in these folders before the package, which another package may import: numba imports `coverage`."""
    modules = modules_beside_the_packages()
    installed = importlib.metadata.packages_distributions().keys() | sys.stdlib_module_names | {"coverage", "numba"}
    assert {"interval_coverage", "browser"} <= modules
    assert not modules & installed


def test_the_tests_that_compile_quickly_are_those_of_a_plain_run():
    """`tests/conftest.py` compares the chosen marks with this expression."""
    options = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]["addopts"]
    ordinary = re.search(r'^ORDINARY = "(.*)"$', (ROOT / "tests" / "conftest.py").read_text(), re.MULTILINE)
    assert ordinary
    assert f"-m '{ordinary[1]}'" in options
