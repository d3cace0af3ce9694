"""How a run ended: codes of the integration, and words for users.

The codes are `RUNNING`, `REACHED_END` (at the horizon), `CROSSED` (on the event), `LEFT_DOMAIN`, `FAILED` and
`UNRESOLVED`. `tippe.Status` has the words.
"""

import enum
from typing import Self

#: In this order: not ended; ended at the horizon; ended on its event; ended where the model ceases to hold; stopped by
#: step-size control; stopped because the mode changed too often or the forces are not determined.
RUNNING, REACHED_END, CROSSED, LEFT_DOMAIN, FAILED, UNRESOLVED = range(6)

#: Words of earlier versions that may be in files and scripts.
FORMER_WORDS = {"reached t1": "completed", "reached_end": "completed"}


class Status(enum.IntEnum):
    """How a run ended: the words that all functions use, and the integers for transformations.

    Runs and tables contain the word, such as "contact_lost"; runs inside `jit` and `vmap` contain the integer. (Files
    have other integers, which the attribute `flag_meanings` explains.)

    - `COMPLETED`: the run reached its horizon `t1`. `INVERTED` and `NOT_INVERTED`: whether the top had turned over by then, in
      tables of inversion times, whose runs end at the inversion.
    - `CONTACT_LOST`: the ground would have to pull. `JAMMED`: the equation for the normal force has no solution.
      `DOES_NOT_FIT`: the arena is as strongly curved as the top. `RANK_LOST`: the projected heading of a stroller is
      undetermined.
    - `UNRESOLVED`: the model determines no motion, or the run changed its mode too often. `FAILED`: the integration
      failed. `ILLEGAL`: a number inside a transformation is out of range, and all results are NaN.
    - `EVENT`: the run reached the event of a table, and ended there. `STOPPED`: a mode without a reset ended.
    - `PENDING`: a cell of a table that has not been computed.

    **Example:**

    ```
    >>> import tippe
    >>> tippe.Status(1).word, int(tippe.Status.of("contact_lost"))
    ('contact_lost', 1)
    >>> tippe.Status.of("reached t1").word  # the word of an earlier version
    'completed'

    ```
    """

    PENDING = -1
    COMPLETED = 0
    CONTACT_LOST = 1
    FAILED = 2
    JAMMED = 3
    ILLEGAL = 4
    DOES_NOT_FIT = 5
    UNRESOLVED = 6
    INVERTED = 7
    NOT_INVERTED = 8
    RANK_LOST = 9
    REVERSED = 10
    NOT_REVERSED = 11
    EVENT = 12
    STOPPED = 13

    @property
    def word(self) -> str:
        """The word for the status in results and files."""
        return self.name.lower()

    @classmethod
    def of(cls, word: str) -> Self:
        """The status for a word of this version or an earlier version.

        **Raises:** `ValueError` for an unknown word.
        """
        known = {status.word: status for status in cls}
        current = FORMER_WORDS.get(word, word)
        if current not in known:
            raise ValueError(f"word = {word!r} must be one of {', '.join(known)}")
        return known[current]
