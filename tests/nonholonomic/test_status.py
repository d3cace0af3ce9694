"""The status words are the same in results of both packages, in tables, and in files of earlier versions."""

import h5py
import numpy as np
import pytest
import xarray

import nonholonomic
import stroller
import tippe
from nonholonomic.runs.table import WORDS, TableForm
from nonholonomic.sweeps import Table, Variable, axis, sweep
from stroller.runs.model import FORM
from tippe.runs.model import INVERSIONS, REVERSALS

pytestmark = pytest.mark.oldest

Status = nonholonomic.Status

#: The words in files of earlier versions.
FORMER = ("reached_end", "contact_lost", "failed", "jammed")
CELLS = np.arange(12.0)


def test_both_packages_hand_out_one_list_whose_integers_do_not_change():
    assert tippe.Status is stroller.Status is Status
    words = {status.word: int(status) for status in Status}
    assert words == {
        "pending": -1,
        "completed": 0,
        "contact_lost": 1,
        "failed": 2,
        "jammed": 3,
        "illegal": 4,
        "does_not_fit": 5,
        "unresolved": 6,
        "inverted": 7,
        "not_inverted": 8,
        "rank_lost": 9,
        "reversed": 10,
        "not_reversed": 11,
        "event": 12,
        "stopped": 13,
    }
    assert all(Status.of(word) is status for word, status in zip(words, Status, strict=True))


def test_words_of_earlier_versions_are_understood_and_others_refused():
    assert Status.of("reached t1") is Status.of("reached_end") is Status.COMPLETED
    with pytest.raises(ValueError, match="word = 'finished' must be one of pending, completed, contact_lost"):
        Status.of("finished")


def test_all_tables_use_words_of_the_list():
    assert tuple(Status(code).word for code in range(len(WORDS))) == WORDS
    kept = {status: status for status in Status if status is not Status.PENDING}
    for form in (TableForm(), FORM, INVERSIONS, REVERSALS):
        assert {Status(k): Status(code) for k, code in enumerate(form.codes)} == kept | (form.named or {})
    assert INVERSIONS.named == {Status.EVENT: Status.INVERTED, Status.COMPLETED: Status.NOT_INVERTED}
    assert REVERSALS.named == {Status.EVENT: Status.REVERSED, Status.COMPLETED: Status.NOT_REVERSED}
    assert FORM.named == {Status.EVENT: Status.CONTACT_LOST}


def swept(words, path, fails_at=np.inf):
    """A sweep of three chunks with statuses 0 to 3 and, from the ninth cell on, a new status if given."""

    def job(columns, count):
        place = columns["x"].astype(int)
        if count and place[0] >= fails_at:
            raise KeyboardInterrupt
        status = np.where((place > 8) & (len(words) > 4), 5, place % 4)
        return {"value": columns["x"], "status": status.astype(np.int8)}

    variables = {"value": Variable("m", np.float64), "status": Variable("1", np.int8, words)}
    return sweep(job, [axis("x", "x", "m", CELLS)], variables, {"what": "a test"}, path=path, chunk=4, progress=False)


def test_a_file_with_the_words_of_earlier_versions_is_read_with_those_of_today(tmp_path):
    swept(FORMER, tmp_path / "old.h5")
    with h5py.File(tmp_path / "old.h5") as file:
        assert file["status"].attrs["flag_meanings"].decode().split() == list(FORMER)
    table = Table.load(tmp_path / "old.h5")
    assert table.status.tolist() == 3 * ["completed", "contact_lost", "failed", "jammed"]
    assert table.words["status"][0] == "completed"
    assert table.to_xarray()["status"].values[0] == "completed"
    # The same call finds all of it done.
    assert swept(WORDS, tmp_path / "old.h5", fails_at=0).status.tolist() == table.status.tolist()
    table.save(tmp_path / "new.h5")
    with xarray.open_dataset(tmp_path / "new.h5", engine="h5netcdf") as dataset:
        assert dataset["status"].attrs["flag_meanings"].split()[0] == "completed"


def test_a_sweep_that_was_begun_with_the_former_words_goes_on_with_all_of_today(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        swept(FORMER, tmp_path / "old.h5", fails_at=8)
    part = Table.load(tmp_path / "old.h5")
    assert set(part.status) <= {"completed", "contact_lost", "failed", "jammed", "pending"}
    table = swept(WORDS, tmp_path / "old.h5")
    assert table.status.tolist() == [*2 * WORDS[:4], "completed", *3 * ["does_not_fit"]]
