"""Pictures of what the other rooms compute. No other room needs this one to compute anything."""

from .plot import draw_portrait as draw_portrait
from .plot import draw_table as draw_table
from .plot import new_figure as new_figure
