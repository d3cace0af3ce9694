"""The questions about runs, once for every model: a run, the time of an event, tables, fits, exponents, pages.

An `AbstractModel` answers what one system is: its modes for a start, its quantities, its words for how a run ends, and its
parameters by name. `model_of` finds the model of a scene or of a user's own system.
"""

from ..hybrid.saltation import UNMEASURED as UNMEASURED
from ..hybrid.saltation import Clock as Clock
from ..identification.posterior import Prior as Prior
from .event import Ensemble as Ensemble
from .event import EventFunction as EventFunction
from .event import EventTime as EventTime
from .event import event_time as event_time
from .event import time_of_event as time_of_event
from .event import with_event as with_event
from .identify import AbstractEventTimes as AbstractEventTimes
from .identify import Data as Data
from .identify import EventTimes as EventTimes
from .identify import Recording as Recording
from .identify import fit_runs as fit_runs
from .identify import identify as identify
from .identify import log_density as log_density
from .identify import posterior_of_runs as posterior_of_runs
from .lyapunov import LyapunovExponent as LyapunovExponent
from .lyapunov import exponent_of_model as exponent_of_model
from .lyapunov import lyapunov_exponent as lyapunov_exponent
from .model import AbstractModel as AbstractModel
from .model import AbstractSceneModel as AbstractSceneModel
from .model import Names as Names
from .model import Start as Start
from .model import model_of as model_of
from .model import statuses as statuses
from .simulate import evenly_spaced as evenly_spaced
from .simulate import sampled_if_legal as sampled_if_legal
from .simulate import simulate as simulate
from .sweep import Options as Options
from .sweep import check_cells as check_cells
from .sweep import compute_table as compute_table
from .sweep import full_sensitivities as full_sensitivities
from .sweep import samples_of as samples_of
from .sweep import sweep as sweep
from .sweep import table_of as table_of
from .table import TableForm as TableForm
from .table import TableJob as TableJob
from .table import at_the_end as at_the_end
from .trajectory import TOLERANCE as TOLERANCE
from .trajectory import Trajectory as Trajectory
from .trajectory import explore as explore
from .trajectory import explore_model as explore_model
from .trajectory import live_run as live_run
from .trajectory import page_of as page_of
from .trajectory import runs_at_ends as runs_at_ends
from .trajectory import sliders_of as sliders_of
