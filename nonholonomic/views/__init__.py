"""Pictures of what the other rooms compute. No other room needs this one to compute anything."""

from .fit import draw_fit as draw_fit
from .plot import draw_table as draw_table
