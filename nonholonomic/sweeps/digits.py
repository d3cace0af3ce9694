"""Numbers with their correct digits in concise notation: 5.01142(3) is 5.01142 with an error of 0.00003."""

import math

import numpy as np
from jaxtyping import Float, Shaped


def concise(value: float, error: float) -> str:
    """A number with its correct digits and, in parentheses, the error of the last digit, rounded up.

    **Arguments:** `value`, `error`: finite numbers, the error at least 0; with an error of 0, the number is written in
    full.
    """
    if error == 0.0:
        return repr(float(value))
    place = math.floor(math.log10(error))
    # The quotient may exceed a whole number because of rounding.
    digit = math.ceil(error / 10.0**place * (1.0 - 1e-12))
    if digit == 10:
        place, digit = place + 1, 1
    if place > 0:
        return f"{round(value, -place):.0f}({digit * 10**place})"
    return f"{value:.{-place}f}({digit})"


def concise_strings(
    values: Float[np.ndarray, "..."], errors: Float[np.ndarray, "..."], words: Shaped[np.ndarray, "..."]
) -> Shaped[np.ndarray, "..."]:
    """Concise notation for every number of an array, or a word if there is no number.

    **Arguments:**

    - `values`: numbers; not finite if there is none.
    - `errors`: errors of the values; infinite if it is doubtful whether there is a number.
    - `words`: the words for missing numbers, with a question mark if it is doubtful that the number is missing.

    **Returns:** an array of strings.
    """

    def string(value, error, word):
        if np.isinf(error):
            return f"{word}?"
        return concise(value, error) if np.isfinite(value) else str(word)

    strings = [string(*entry) for entry in zip(values.ravel(), errors.ravel(), words.ravel(), strict=True)]
    return np.array(strings, dtype=str).reshape(values.shape)
