"""The README's example runs as it stands, and its commands are the ones that work."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.oldest

README = (Path(__file__).parents[1] / "README.md").read_text()


SNIPPETS = re.findall(r"```python\n(.*?)```", README, re.DOTALL)


def test_the_map_and_the_gradient_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    # A coarser grid of the same shape: the example's own takes longer than a test should.
    exec("".join(SNIPPETS[:2]).replace("36", "4").replace("51", "10"), {})
    assert (tmp_path / "table.h5").exists()
    assert (tmp_path / "table.png").exists()
    # What it prints is what stands below it.
    printed = [float(number) for number in re.findall(r"-?\d+\.\d+", capsys.readouterr().out)]
    stated_numbers = [
        float(number) for number in re.findall(r"-?\d+\.\d+", re.findall(r"^# (\d.*)$", SNIPPETS[1], re.M)[0])
    ]
    assert len(stated_numbers) == 5
    assert stated_numbers == pytest.approx(printed, rel=2e-3)


def test_the_ride_runs(capsys):
    names = {}
    exec(SNIPPETS[2], names)
    assert names["ride"].position.shape[1] == 3
    assert "completed" in capsys.readouterr().out


def test_it_is_short_and_its_links_lead_somewhere():
    assert len(README.splitlines()) <= 90
    for link in re.findall(r"\]\(((?!http)[^)]*)\)", README):
        assert (Path(__file__).parents[1] / link).exists(), link
    assert "pip install '.[test]' && pytest" in README
    assert "NONHOLONOMIC_CACHE=0" in README


def test_every_file_it_names_exists():
    for name in re.findall(r"`((?:tests|tippe|nonholonomic|stroller|benchmarks|docs|examples)/[\w/.]*)`", README):
        assert (Path(__file__).parents[1] / name).exists(), name


#: Looks up names in a fresh process, and tells which heavy packages that has loaded.
LOOK_UP = """
import functools, json, sys
import nonholonomic, stroller, tippe
roots = {"nonholonomic": nonholonomic, "stroller": stroller, "tippe": tippe}
for name in sys.argv[1:]:
    root, *rest = name.split(".")
    functools.reduce(getattr, rest, roots[root])
slow = ("matplotlib", "scipy.integrate", "tippe.paper")
print(json.dumps([name for name in slow if name in sys.modules]))
"""


def test_every_name_it_gives_is_there_after_a_plain_import():
    """Such as `tippe.steady`, a module; and nothing is loaded that takes long."""
    names = sorted(set(re.findall(r"\b(?:tippe|stroller|nonholonomic)\.(?!md\b)\w+", README)))
    assert "tippe.steady" in names
    process = subprocess.run(
        [sys.executable, "-c", LOOK_UP, *names], capture_output=True, text=True, check=True, timeout=120
    )
    assert json.loads(process.stdout) == []
