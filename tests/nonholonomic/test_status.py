"""The status words are the same in results of both packages and in tables."""

import pytest

import nonholonomic
import stroller
import tippe
from nonholonomic.runs.table import WORDS, TableForm
from stroller.runs.model import FORM
from tippe.runs.model import INVERSIONS, REVERSALS

pytestmark = pytest.mark.oldest

Status = nonholonomic.Status


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
