"""Estimate parameters of a model from measurements, and report how well the measurements determine them.

`identify` fits the `Free` parameters from several starts; the `Identification` has standard errors, profile
likelihoods, the combinations that the data do not determine, and a `Verdict`. `Measurements` are the data of a fit.
Recordings of both vehicles are checked, read from files and converted to `Measurements` here.

**Example:** the rate of a decay from a recording. A model of your own has a scene, launches, and runs whose properties
are the quantities that can be recorded.

>>> from typing import NamedTuple
>>> import equinox as eqx
>>> import jax
>>> import jax.numpy as jnp
>>> from nonholonomic.identification import AbstractDataModel, AbstractRecording, Quantities
>>> from nonholonomic.identification import fit_data, predicted, scene_unknowns, search_options
>>> class Scene(eqx.Module):
...     rate: jax.Array
>>> class Launch(eqx.Module):
...     level: jax.Array
>>> class Run(NamedTuple):
...     level: jax.Array
>>> def simulate(scene, launch, times):
...     return Run(launch.level * jnp.exp(-scene.rate * times))
>>> class Recording(AbstractRecording):
...     quantity: str = eqx.field(static=True, default="level")
...     t0: float = 0.0
...     student: None = None
...     quantities = Quantities({}, {"level": "1"}, frozenset())
>>> class Model(AbstractDataModel):
...     scene: Scene
...     data: tuple
...     seen: jax.Array
...     def together(self, source, values):
...         return None
...     def predict(self, sources, rows):
...         return predicted(self.scene, sources, rows, simulate)
>>> scene, launch = Scene(jnp.asarray(1.5)), Launch(jnp.asarray(1.0))
>>> data = (Recording(launch, [1.0, 2.0, 3.0], [0.37, 0.135, 0.05], 0.005),)
>>> free = scene_unknowns({"rate": 1.5}, scene, launch, ["scene.rate"], [["launch.level", "t0"]])
>>> search = search_options(starts=1, spread=2.0, seed=0, max_steps=60, progress=False)
>>> fit = fit_data(lambda seen: Model(scene, data, jnp.asarray(seen)), data, free, search)
>>> print(f"{fit.estimates['scene.rate']:.3f}")
0.997
"""

from .csv import read_columns as read_columns
from .csv import read_launches as read_launches
from .data import free_numbers as free_numbers
from .data import joined as joined
from .data import of_data as of_data
from .data import scene_unknowns as scene_unknowns
from .data import series_units as series_units
from .identify import identify as identify
from .likelihood import Measurements as Measurements
from .model import AbstractDataModel as AbstractDataModel
from .model import as_sources as as_sources
from .model import fit_data as fit_data
from .model import posterior_of_data as posterior_of_data
from .model import search_options as search_options
from .posterior import LogDensity as LogDensity
from .recording import AbstractRecording as AbstractRecording
from .recording import Quantities as Quantities
from .recording import as_quantity as as_quantity
from .recording import model_times as model_times
from .recording import predicted as predicted
from .result import Identification as Identification
from .sampling import Draws as Draws
from .sampling import sample as sample
from .unknown import Free as Free
from .verdict import FitWarning as FitWarning
