"""Files and folders that docstrings, comments and documents cite are there."""

import io
import re
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]

#: A Python file or a document, or a folder in backquotes, with or without the folders that it lies in.
CITED = re.compile(r"(?<![\w./<])(?:[\w.-]+/)*[\w-]+\.(?:py|md)\b|(?<=`)(?:[\w.-]+/)+(?=`)")

FOLDERS = ("nonholonomic", "tippe", "stroller", "tests", "benchmarks", "examples", "docs", "reference", "paper")

TEXTS = [
    *ROOT.glob("*.md"),
    *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix in (".py", ".md")),
]

#: Every file, and every folder with a stroke at its end, by each ending of its path.
THERE = {
    "/".join(parts[first:]) + stroke
    for path in TEXTS
    for parts, stroke in [(path.relative_to(ROOT).parts, ""), *((p.parts, "/") for p in path.relative_to(ROOT).parents)]
    for first in range(len(parts))
}


def prose(text: str) -> str:
    """The docstrings and comments of a program."""
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return "\n".join(
        token.string for token in tokens if token.type == tokenize.COMMENT or token.string.startswith(('"""', 'r"""'))
    )


def missing(path: Path) -> list[str]:
    """What a file cites that is not there."""
    text = path.read_text()
    citations = CITED.findall(prose(text) if path.suffix == ".py" else text)
    return [cited for cited in citations if re.sub(r"^(?:\.\./)+", "", cited) not in THERE]


def test_what_is_not_there_is_found(tmp_path):
    program = tmp_path / "program.py"
    program.write_text('"""As in `step.py` and `marsh.py`."""\nx = "no.py"  # in `rooms/` and `sweeps/`\n')
    assert missing(program) == ["marsh.py", "rooms/"]


def test_every_file_that_is_cited_exists():
    assert {str(path.relative_to(ROOT)): names for path in TEXTS if (names := missing(path))} == {}
