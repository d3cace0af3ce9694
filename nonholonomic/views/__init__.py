"""Pictures, films and pages of results. The subpackages above compute the results, and use these functions to draw
them."""

from .film import Viewable as Viewable
from .film import require_others as require_others
from .fit import draw_fit as draw_fit
from .page import NO_VIEW as NO_VIEW
from .page import Page as Page
from .page import can_view as can_view
from .page import page as page
from .page import picture_as_html as picture_as_html
from .page import table_as_html as table_as_html
from .plot import draw_portrait as draw_portrait
from .plot import draw_series as draw_series
from .plot import draw_table as draw_table
from .plot import new_figure as new_figure
from .stage import COLOURS as COLOURS
from .stage import DARK as DARK
from .stage import PALE as PALE
from .stage import Arena as Arena
from .stage import Arrow as Arrow
from .stage import Body as Body
from .stage import Curve as Curve
from .stage import Mesh as Mesh
from .stage import Show as Show
from .stage import Stage as Stage
from .stage import Trace as Trace
from .stage import arena as arena
from .stage import ball as ball
from .stage import bar as bar
from .stage import box as box
from .stage import css as css
from .stage import distinguished_by_colour as distinguished_by_colour
from .stage import rod as rod
from .stage import striped as striped
from .stage import turned as turned
from .stage import wheel as wheel
