"""Every call that takes long where its programs are new says so: none of them computes here, each only waits."""

import importlib
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from terminal import left, watched, words
from tops import rutstam_top

import stroller
import tippe
from nonholonomic.identification import Identification, LogDensity, Measurements, identify
from nonholonomic.runs.trajectory import AbstractRun
from nonholonomic.sweeps import Tabular

pytestmark = pytest.mark.oldest

TOP = tippe.Scene(rutstam_top(), friction=tippe.Viscous(0.3))
LAUNCH = tippe.Launch(0.1, 155.0)
TIMES = tippe.InversionTimes(tippe.Launch(0.1, [155.0]), [5.6], error=0.1, t1=8.0)
STROLLER = stroller.Scene(stroller.Stroller(12.0, 0.7, 1.5, 0.05))
RIDE = stroller.Launch((0.0, 0.0), 0.3, 2.0)
RECORDING = stroller.Recording(RIDE, [0.0, 1.0], [2.0, 2.0], 0.1, "speed")
DECAY = Measurements([2.0, 1.0], [0.1, 0.1])

#: What is called, and the function in which it waits, by its module and name.
CALLS = {
    "inversion_time": (
        lambda: tippe.inversion_time(TOP, LAUNCH, 8.0),
        "tippe.runs.verbs",
        "time_of_event",
    ),
    "extended": (
        lambda: tippe.extended_inversion_time(TOP, LAUNCH, 8.0),
        "tippe.runs.verbs",
        "differentiable_solve",
    ),
    "simulate": (lambda: tippe.simulate(TOP, LAUNCH, 1.0), "tippe.runs.trajectory", "follow"),
    "exponent": (lambda: tippe.lyapunov_exponent(TOP, LAUNCH, 1.0), "tippe.runs.verbs", "exponent_of_model"),
    "ride": (lambda: stroller.simulate(STROLLER, RIDE, 1.0), "stroller.runs.trajectory", "followed"),
    "identify": (lambda: tippe.identify(TOP, TIMES, {"mu": 0.3}), "nonholonomic.runs.identify", "free_numbers"),
    "stroller identify": (
        lambda: stroller.identify(STROLLER, RECORDING, {"mass": 12.0}),
        "nonholonomic.runs.identify",
        "free_numbers",
    ),
    "any fit": (lambda: identify(None, DECAY, {"x": 1.0}), "nonholonomic.identification.result", "search"),
    "its end": (lambda: fitted(), "nonholonomic.identification.result", "summarise"),
    "density": (lambda: LogDensity.__call__(stub("predict"), np.zeros(1)), None, None),
    "gradient": (
        lambda: LogDensity.value_and_gradient(SimpleNamespace(), [0.0]),
        "nonholonomic.identification.posterior",
        "_value_and_gradient",
    ),
    "profile": (lambda: Identification.profile(stub("_place"), "x"), None, None),
    "page": (lambda: SlowRun().view(), None, None),
    "film": (lambda: SlowRun().animate("a.webm"), None, None),
    "curves": (lambda: SlowRun().plot(), None, None),
    "table of a run": (lambda: AbstractRun.to_table(stub("table_of")), None, None),
    "words on a run": (lambda: AbstractRun.__str__(stub("in_words", t=np.zeros(1), codes=None)), None, None),
}


class Enough(Exception):
    """It has waited."""


def waits(*_, **__):
    time.sleep(0.25)
    raise Enough


class SlowRun(Tabular):
    """A run that takes long to describe for a page."""

    stages = waits
    portrait_axes = ("x", "y")

    def to_table(self):
        raise NotImplementedError


def stub(name, **attributes):
    return SimpleNamespace(**{name: waits}, of_prediction=None, **attributes)


def fitted():
    return identify(lambda p: p["x"][:, None] * np.array([2.0, 1.0]), DECAY, {"x": 1.0}, progress=True)


@pytest.mark.parametrize("name", CALLS)
def test_a_long_call_says_what_it_does_and_leaves_nothing_behind(name, monkeypatch):
    call, module, function = CALLS[name]
    # A film needs a browser, which is never started here.
    monkeypatch.setattr("nonholonomic.views.pages.BROWSERS", (sys.executable,))
    if module is not None:
        monkeypatch.setattr(importlib.import_module(module), function, waits)
    terminal = watched(monkeypatch)
    with pytest.raises(Enough):
        call()
    assert words(terminal)[-1] in ("simulating", "fitting", "drawing", "reading")
    assert left(terminal) == ""


def test_sampling_says_what_it_does_after_its_last_step(monkeypatch):
    module = importlib.import_module("nonholonomic.identification.result")
    monkeypatch.setattr(module, "drawn", lambda *_: (np.zeros((4, 2, 1)), 0.5, 1, 0.0))
    monkeypatch.setattr(module.Draws, "of", waits)
    terminal = watched(monkeypatch)
    with pytest.raises(Enough):
        module.sample(None, warmup=1, draws=2)
    assert words(terminal)[-1] == "diagnosing"
