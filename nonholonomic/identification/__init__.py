"""Finding the parameters of a model from measurements, and how well the measurements determine them.

`identify` fits the `Free` parameters from several starts; the `Identification` has standard errors, profile
likelihoods, and the combinations that the data do not determine.
"""

from .identify import free_numbers as free_numbers
from .identify import identify as identify
from .identify import joined as joined
from .likelihood import Measurements as Measurements
from .recording import check_recording as check_recording
from .recording import sample_labels as sample_labels
from .recording import samples as samples
from .result import Identification as Identification
from .unknown import Free as Free
