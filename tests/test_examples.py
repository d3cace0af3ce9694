"""The examples are short, and run."""

import contextlib
import re
import runpy
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from tippe import FitWarning

EXAMPLES = sorted((Path(__file__).parents[1] / "examples").glob("*.py"))

#: What an example must find, as a pattern of its output.
FINDS = {
    "a_page": r"Page of \d\.\d\d MB(?s:.*)wrote tops.html, top.webm and curves.png into page-out",
    "explore_top": r"Page of \d\.\d\d MB",
    "explore_ride": r"Page of \d\.\d\d MB",
    "fastest_top": r"0\.42\d\d, I1 / I3 1\.0\d\d\d: 4\.21\d s, least force 0\.9200 mg\nOf 64 tops around it 0 are faster",
    "hilly_ride": r"end speed \d\.\d+ m/s;.*\n.*\n.*\ncontact lost in \d+ of 12 rides",
    "mu_and_offset": r"(?s)2 numbers from 10 measurements: converged\n.*4 of 4 refined candidates ended at the best minimum",
    "stroller_damping": r"(?s)2 numbers from 90 measurements: converged\n.*4 of 4 refined candidates ended at the best minimum",
    "bowl_map": r"(?s)bowl: seconds to 0\.95 pi.* 5\.416 .*waves: seconds to 0\.95 pi",
    "next_launch": r"fix mu to 2\d %, offset to 2\d %\nnext: theta 0\.005, spin 70 rad/s: then mu to 0\.9\d? %",
    "parking": r"Plan of 15 s: reaches the goal(?s:.*)clearance  0\.0\d+ m from 4 obstacles",
    "planned_top": r"\d\d of 64 launches turn over(?s:.*)level at 5\.00000 s, \[0\.3 0\.2\] m",
    "posterior": r"4 chains of 500 draws, [3-9]\d % accepted(?s:.*)mu  0\.(2[6-9]|3[0-3])\d+ (?s:.*)100 % of the times lie",
    "cohens_figure": r"(?s)slip_speed = 0\.11\d,.*mu = 0\.3\d\d,.*known to 0\.\d+ %: .*known to \d+ %: ",
    "printed_numbers": r"(?s)top: 77\.18 27\.41\n.*known to 3\.9 %.*mu \+1 %: not at all.*top: 2\.077 55\.78 -11\.16",
    "lost_numbers": r"(?s)29\.59 at the most likely values, 11 degrees.*\n\[29\.592\d* 31\.242\d* 31\.238\d* 32\.285\d*\]",
}


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_short_and_can_be_read(path):
    assert len(path.read_text().splitlines()) <= 60
    names = runpy.run_path(str(path))
    assert callable(names["draw" if "draw" in names else "main"])


#: Pictures that take more than four seconds.
LONG = ("rattleback", "parking", "planned_top", "onto_its_stem", "flights", "explore_ride", "explore_top", "bowl_rides")


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[pytest.mark.slow] * (path.stem in LONG))
        for path in EXAMPLES
        if "def draw()" in path.read_text()
    ],
)
def test_a_picture_of_the_gallery_is_drawn(path, tmp_path, monkeypatch):
    # Some write files.
    monkeypatch.chdir(tmp_path)
    picture = runpy.run_path(str(path))["draw"]()
    plt.close("all")
    assert picture.axes if hasattr(picture, "axes") else "facts" in picture.html


#: What an example is warned of, where that is what it shows.
WARNED = {"lost_numbers": "the data do not determine"}


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, capsys, tmp_path, monkeypatch):
    # Some write files.
    monkeypatch.chdir(tmp_path)
    names = runpy.run_path(str(path))
    if "main" in names:
        with pytest.warns(FitWarning, match=WARNED[path.stem]) if path.stem in WARNED else contextlib.nullcontext():
            names["main"]()
        assert re.search(FINDS[path.stem], capsys.readouterr().out)
