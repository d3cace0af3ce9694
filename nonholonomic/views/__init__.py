"""Pictures, animations and pages of what the other rooms compute. No other room needs this one to compute anything."""

from .arena import arena as arena
from .fit import draw_fit as draw_fit
from .meshes import ball as ball
from .meshes import bar as bar
from .meshes import box as box
from .meshes import rod as rod
from .meshes import wheel as wheel
from .page import Page as Page
from .page import can_view as can_view
from .page import page as page
from .plot import draw_portrait as draw_portrait
from .plot import draw_table as draw_table
from .plot import new_figure as new_figure
from .stage import COLOURS as COLOURS
from .stage import DARK as DARK
from .stage import PALE as PALE
from .stage import Arrow as Arrow
from .stage import Body as Body
from .stage import Curve as Curve
from .stage import Mesh as Mesh
from .stage import Show as Show
from .stage import Stage as Stage
from .stage import Trace as Trace
from .stage import turned as turned
from .viewable import Viewable as Viewable
