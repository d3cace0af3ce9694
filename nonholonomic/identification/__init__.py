"""Estimate parameters of a model from measurements, and report how well the measurements determine them.

`identify` fits the `Free` parameters from several starts; the `Identification` has standard errors, profile
likelihoods, the combinations that the data do not determine, and a `Verdict`. `Measurements` are the data of a fit.
Recordings of both vehicles are checked, read from files and converted to `Measurements` here.
"""

from .csv import read_columns as read_columns
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
from .verdict import Verdict as Verdict
