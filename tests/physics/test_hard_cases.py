"""Every row of `benchmarks/hard_cases.py` keeps its bound, and one that does not makes the script fail."""

import math

import hard_cases
import pytest
from hard.row import Row

#: Rows that take long to compile or to run.
SLOW = (
    *("no_offset", "no_friction_at_all", "huge_cylinder", "spins_of_all_sizes", "extreme_inertias", "tight_cylinder"),
    *("inverted_exactly", "ball_that_drills", "ball_that_rolls", "energy_under_torque", "torques_by_lagrange"),
    *("chaos_in_a_cylinder", "the_law_itself", "over_to_the_stem", "stick_and_slip_again", "leaning_on_the_stem"),
    *("explicit_at_a_tenth", "orderly_without_friction", "energy_through_hops", "bounces", "coulomb_hops"),
    *("leaning_for_ever", "over_the_crest", "no_room", "a_thousand_seconds_in_a_bowl"),
    *("jellett_through_hops", "hops", "explicit_at_a_hundredth", "rate_of_the_rise", "just_above_the_threshold"),
    *("upright_almost", "explicit_at_a_thousandth", "explicit_at_a_ten_thousandth", "just_below_the_threshold"),
    *("jellett_under_torque", "implicit_at_a_tenth"),
)

ROWS = [
    pytest.param(row, id=row.__name__, marks=[pytest.mark.slow] if row.__name__ in SLOW else [])
    for subject in hard_cases.SUBJECTS
    for row in subject.rows()
]


@pytest.mark.filterwarnings(
    "ignore:spin = .* was it in rpm",
    "ignore:surface.* is larger than a room",
    "ignore:theta = 0.0 is exactly upright",
    "ignore:friction = Frictionless",
)
@pytest.mark.parametrize("row", ROWS)
def test_the_row_keeps_its_bound(row):
    entry = row()
    assert entry.ok, entry


@pytest.mark.parametrize(("error", "status"), [(0.5, 0), (2.0, 1), (math.nan, 1), (math.inf, 1)])
def test_a_broken_bound_is_the_exit_status(error, status, tmp_path, monkeypatch, capsys):
    """The table is printed and written all the same."""

    def the_case():
        return Row("a case", "what happens", error, 1.0, "nothing", 1, 0.001, "completed")

    class Subject:
        rows = staticmethod(lambda: [the_case])

    file = tmp_path / "rows.csv"
    monkeypatch.setattr(hard_cases, "SUBJECTS", (Subject,))
    monkeypatch.setattr("sys.argv", ["hard_cases.py", "--only", "the_case", "--csv", str(file)])
    assert hard_cases.main() == status
    assert "| the_case |" in capsys.readouterr().out
    assert file.read_text().count("a case") == 1
