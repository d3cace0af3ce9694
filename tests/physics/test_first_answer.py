"""`benchmarks/first_answer.py` times the same task in processes of their own."""

import first_answer
import pytest


@pytest.mark.slow
def test_two_programs_have_the_same_answer_and_say_what_they_waited_for(tmp_path):
    """heyoka, the third, is no test dependency."""
    first_answer.write_task(1, tmp_path)
    rows = [first_answer.measured(program, 1, "cold", tmp_path) for program in ("inversion_table", "Diffrax")]
    for row in rows:
        assert row is not None
        seconds = sum(float(row[f"{name} [s]"]) for name in first_answer.PHASES)
        assert 0.3 * float(row["whole [s]"]) < seconds <= float(row["whole [s]"])
    own, other = (float(row["last time [s]"]) for row in rows)
    assert own == pytest.approx(other, abs=1e-7)
