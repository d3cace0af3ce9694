"""Estimate parameters of a model from measurements, and report how well the measurements determine them.

`identify` fits the `Free` parameters from several starts; the `Identification` has standard errors, profile
likelihoods, the combinations that the data do not determine, and a `Verdict`. `Measurements` are the data of a fit.
Recordings of both vehicles are checked, read from files and converted to `Measurements` here.

**Example:** the rate of a decay from three measurements.

>>> import jax.numpy as jnp
>>> from nonholonomic.identification import LogDensity, Measurements, identify
>>> def decay(p):
...     return jnp.exp(-p["rate"][:, None] * jnp.array([1.0, 2.0, 3.0]))
>>> measured, free = Measurements([0.37, 0.135, 0.05], 0.005), {"rate": 1.5}
>>> fit = identify(decay, measured, free, progress=False)
>>> print(f"{fit.estimates['rate']:.3f}")
0.997
"""

from .posterior import Free as Free
from .posterior import LogDensity as LogDensity
from .posterior import Measurements as Measurements
from .recording import AbstractRecording as AbstractRecording
from .recording import Quantities as Quantities
from .recording import as_quantity as as_quantity
from .recording import read_columns as read_columns
from .recording import read_launches as read_launches
from .result import Draws as Draws
from .result import Identification as Identification
from .result import identify as identify
from .result import sample as sample
from .search import FitWarning as FitWarning
