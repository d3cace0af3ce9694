"""Pages with sliders that simulate in the browser, with equations generated from their jaxprs."""

from .javascript import javascript as javascript
from .live import Answer as Answer
from .live import Frame as Frame
from .live import HybridSimulator as HybridSimulator
from .live import LiveRun as LiveRun
from .live import Simulator as Simulator
from .live import Slider as Slider
from .live import Summary as Summary
from .live import live_page as live_page
from .live import programs as programs
from .live import quaternion as quaternion
