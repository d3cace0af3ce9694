"""Pictures, films and pages of results. The subpackages above compute the results, and use these functions to draw
them."""

from .pages import Page as Page
from .pages import stage_of as stage_of
from .plot import draw_fit as draw_fit
from .stage import COLOURS as COLOURS
from .stage import DARK as DARK
from .stage import PALE as PALE
from .stage import Arena as Arena
from .stage import Arrow as Arrow
from .stage import Ball as Ball
from .stage import Body as Body
from .stage import Box as Box
from .stage import Curve as Curve
from .stage import Disc as Disc
from .stage import Line as Line
from .stage import Mesh as Mesh
from .stage import Show as Show
from .stage import Stage as Stage
from .stage import Trace as Trace
from .stage import Wheel as Wheel
