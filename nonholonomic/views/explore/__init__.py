"""Pages with sliders that simulate in the browser, with equations generated from their jaxprs."""

from .frame import Frame as Frame
from .frame import quaternion as quaternion
from .hybrid_simulator import HybridSimulator as HybridSimulator
from .javascript import javascript as javascript
from .live import Answer as Answer
from .live import LiveRun as LiveRun
from .live import Slider as Slider
from .live import Summary as Summary
from .live import live_page as live_page
from .live import programs as programs
from .simulator import Simulator as Simulator
