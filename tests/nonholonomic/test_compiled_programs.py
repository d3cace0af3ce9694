"""Compiled programs are forgotten before they exhaust the memory, with a warning of one line, and only then."""

import logging

import jax
import jax.numpy as jnp
import pytest

from nonholonomic.compilation import cache
from nonholonomic.compilation.cache import count_mappings, forget_programs_if_many, memory_of_machine, resident_memory

pytestmark = [
    pytest.mark.oldest,
    pytest.mark.skipif(count_mappings() == 0, reason="this system does not report mappings"),
]


@pytest.fixture
def program():
    """A compiled program that tells how often it was traced."""
    traced = []

    @jax.jit
    def double(x):
        traced.append(x)
        return 2.0 * x

    double(1.0)
    return double, traced


def test_what_a_process_uses_is_known():
    assert 1e8 < resident_memory() < memory_of_machine() < 1e15
    assert 100 < count_mappings() < cache.most_mappings()


def test_little_memory_forgets_nothing(program, caplog):
    double, traced = program
    assert not forget_programs_if_many(10**12)
    assert double(3.0) == 6.0
    assert len(traced) == 1
    assert not caplog.records


@pytest.mark.parametrize("why", ["memory", "mappings"])
def test_much_memory_or_many_mappings_forget_all_programs_with_one_line(why, program, caplog, monkeypatch):
    double, traced = program
    monkeypatch.setattr(cache, "MANY_MAPPINGS", 10)
    monkeypatch.setattr(cache, "LITTLE_MEMORY", 1000)
    if why == "mappings":
        monkeypatch.setattr(cache, "most_mappings", lambda: 10)
    with caplog.at_level(logging.WARNING):
        assert forget_programs_if_many(1000 if why == "memory" else 10**12)
    assert double(3.0) == 6.0
    assert len(traced) == 2
    (message,) = caplog.messages
    assert message.endswith("memory mappings and were cleared; the next calls compile again")
    assert "\n" not in message


def test_memory_that_programs_do_not_take_forgets_nothing(program, monkeypatch):
    """Such as a large table: forgetting programs would not help, in any call."""
    monkeypatch.setattr(cache, "MANY_MAPPINGS", 10**9)
    double, traced = program
    array = jnp.zeros(1_000_000)
    assert not forget_programs_if_many(1000)
    assert double(3.0) == 6.0
    assert len(traced) == 1
    assert array.nbytes


def test_looking_at_the_memory_compiles_nothing(program, monkeypatch):
    monkeypatch.setattr(cache, "MANY_MAPPINGS", 10**9)
    compiled = []
    jax.clear_caches()

    def record(event, duration, **_):
        compiled.append(event)

    jax.monitoring.register_event_duration_secs_listener(record)
    try:
        assert not forget_programs_if_many(1000)
    finally:
        jax.monitoring.unregister_event_duration_listener(record)
    assert compiled == []


def test_nothing_is_forgotten_while_a_program_is_traced(monkeypatch):
    monkeypatch.setattr(cache, "MANY_MAPPINGS", 10)
    calls = []

    @jax.jit
    def inner(x):
        calls.append(forget_programs_if_many(1000))
        return x

    inner(1.0)
    assert calls == [False]
