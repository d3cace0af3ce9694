"""The README's example runs as it stands, and its commands are the ones that work."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.newest

README = (Path(__file__).parents[1] / "README.md").read_text()


def test_the_ten_lines_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, _ = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    # A coarser grid of the same shape: the example's own takes longer than a test should.
    exec(code.replace("36", "4").replace("51", "10"), {})
    assert (tmp_path / "table.h5").exists()
    assert (tmp_path / "table.png").exists()
    assert "5.96" in capsys.readouterr().out


def test_the_ride_runs(capsys):
    _, code = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names = {}
    exec(code, names)
    assert names["table"].shape == (3, 2)
    assert names["ride"].position.shape[1] == 3


def test_every_file_it_names_exists():
    for name in re.findall(r"`((?:tests|tippe|nonholonomic|stroller|benchmarks|docs)/[\w/.]*)`", README):
        assert (Path(__file__).parents[1] / name).exists(), name


#: Looks up names in a fresh process, and tells which heavy packages that has loaded.
LOOK_UP = """
import functools, json, sys
import nonholonomic, stroller, tippe
roots = {"nonholonomic": nonholonomic, "stroller": stroller, "tippe": tippe}
for name in sys.argv[1:]:
    root, *rest = name.split(".")
    functools.reduce(getattr, rest, roots[root])
slow = ("matplotlib", "scipy.integrate", "tippe.papers.paper", "stroller.papers.paper")
print(json.dumps([name for name in slow if name in sys.modules]))
"""


def test_every_name_it_gives_is_there_after_a_plain_import():
    """Such as `tippe.steady`, a module; and nothing is loaded that takes long."""
    names = sorted(set(re.findall(r"\b(?:tippe|stroller|nonholonomic)\.(?!md\b)\w+", README)))
    assert "tippe.steady" in names
    done = subprocess.run(
        [sys.executable, "-c", LOOK_UP, *names], capture_output=True, text=True, check=True, timeout=120
    )
    assert json.loads(done.stdout) == []
