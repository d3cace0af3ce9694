"""Tops that fly, bounce, stick and slip."""

from collections.abc import Iterator
from itertools import pairwise

import arena_hop_reference
import coulomb_top
import exact_hop_reference
import numpy as np

from .smooth_tops import ArenaTop, NewtonEuler, arena_scene, top_scene
from .solutions import COARSE, FINE, Array, Scene, bounded_event, rounded_times, top_states


def hops() -> Iterator[Scene]:
    """Two tops that bounce over an arena, at two tolerances, by the program's own event location."""
    for number, case in enumerate(arena_hop_reference.CASES):
        top = ArenaTop(case)
        y = top.start()
        scene = arena_scene(f"hops-{case.arena}-{number + 1}", case, top, y)
        # Steps of other lengths, because the states at the times are interpolated.
        states, flights, _ = arena_hop_reference.follow(case, FINE, 1e-3)
        check, others, _ = arena_hop_reference.follow(case, 10.0 * COARSE, 2e-3)
        times = [fraction * case.t1 for fraction in arena_hop_reference.SAMPLES]
        events = []
        # Bounces shrink until they are too short to matter.
        for flight, other in list(zip(flights, others, strict=False))[:4]:
            events += [bounded_event("takes_off", flight[0], other[0])] if flight[0] > 0.0 else []
            events += [bounded_event("lands", flight[1], other[1])]
        exported = [np.array([top.exported(state) for state in run]) for run in (states, check)]
        yield scene | {
            "restitution": arena_hop_reference.RESTITUTION,
            "outcome": "completed",
            "states": top_states(times, *exported),
            "events": events,
            "source": {
                "values": "flights, impacts in the normal impulse, contact: tests/physics/arena_hop_reference.py, rtol 1e-13",
                "bounds": "the same program, rtol 1e-11, and steps that may be twice as long",
            },
        }


RUTSTAM = (0.02, 0.02, 0.006, 131.0 / 350.0 * 8e-6, 3.2e-6)
COHEN = (0.015, 0.025, 0.005, 0.4 * 0.015 * 0.025**2, 0.4 * 0.015 * 0.025**2)
HOPPING = (0.02, 0.02, 0.016, 1.6e-6, 1.9e-6)
#: Body, mu, radius of a spherical arena, theta, spin, t1, whether it may fly.
STICK_SLIP = {
    "stick-slip-rutstam": (RUTSTAM, 0.2, None, 1.5, 30.0, 0.9, False),
    "stick-slip-cohen": (COHEN, 0.3, None, 0.1, 100.0, 0.05, False),
    "stick-slip-sphere": (RUTSTAM, 0.2, 0.3, 1.5, 30.0, 0.9, False),
    "stick-slip-flight-plane": (HOPPING, 0.5, None, 1.5, 350.0, 0.276, True),
    "stick-slip-flight-sphere": (HOPPING, 0.5, 0.2, 1.5, 350.0, 0.276, True),
}
KIND_OF = {"slipping": "slips", "rolling": "sticks", "flying": "takes_off"}


def stick_slip() -> Iterator[Scene]:
    """Exact Coulomb friction, event by event; in the two last scenes with flights, where impacts slip on or stick."""
    for name, (numbers, mu, arena, theta, spin, t1, flies) in STICK_SLIP.items():
        curved = (0.0, 0.0, 0.0) if arena is None else (1.0, 1.0, 1.0)
        body = coulomb_top.Body(*numbers, mu, 9.81, arena, curved)
        top = NewtonEuler(body, None)
        y = top.start(theta, spin, 0.0, 0.0)

        def follow(t: float, rtol: float, floor: float, body=body, y=y, flies=flies) -> list[tuple[str, float, Array]]:
            """Kind, begin and last state of every stretch."""
            if flies:
                run = exact_hop_reference.follow(body, y, t, 0.0, rtol, floor)
                return [(piece.kind, piece.begin, piece.state) for piece in run]
            run = coulomb_top.follow(body, y, t, floor, 0.01 * floor, rtol)
            return [(piece.kind, piece.times[0], piece.states[:, -1]) for piece in run]

        times = rounded_times(t1, (0.25, 0.5, 0.75, 1.0))
        accuracies = ((1e-11, 1e-8), (1e-10, 1e-7))
        states = [np.array([top.exported(follow(t, *accuracy)[-1][2]) for t in times]) for accuracy in accuracies]
        lists = [events_of(follow(t1, *accuracy)) for accuracy in accuracies]
        assert [kind for kind, _ in lists[0]] == [kind for kind, _ in lists[1]]
        events = [bounded_event(kind, time, other[1]) for (kind, time), other in zip(*lists, strict=True)]
        shape = {"shape": "plane", "tilt": 0.0} if arena is None else {"shape": "sphere", "radius": arena}
        program = "exact_hop_reference.py" if flies else "coulomb_top.py"
        scene = top_scene(name, top, y, shape) | {"friction": {"law": "set-valued coulomb", "mu": mu}}
        yield (
            scene
            | ({"restitution": 0.0} if flies else {})
            | {
                "outcome": "completed",
                "states": top_states(times, *states),
                "events": events,
                "source": {
                    "values": f"stretch by stretch, tests/physics/{program}, rtol 1e-11, a slip ends at 1e-8 m/s",
                    "bounds": "the same program, rtol 1e-10, a slip ends at 1e-7 m/s",
                },
            }
        )


def events_of(stretches: list[tuple[str, float, Array]]) -> list[tuple[str, float]]:
    """What begins each stretch that is of another kind than the one before; a flight ends with a landing."""
    return [
        ("lands" if before[0] == "flying" else KIND_OF[after[0]], after[1])
        for before, after in pairwise(stretches)
        if before[0] != after[0]
    ]
