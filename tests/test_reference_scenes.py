"""The reference scenes: they keep to their schema, are what their programs compute, and are what the package computes."""

import json
from pathlib import Path

import check
import generate
import jsonschema
import numpy as np
import pytest
import with_nonholonomic
from close import assert_close

ROOT = Path(check.__file__).parent

SCENES = {path.stem: json.loads(path.read_text()) for path in sorted((ROOT / "scenes").glob("*.json"))}

#: The scenes of the ordinary run: two programs, for smooth runs on the plane and for their inversion times, and one for rides.
QUICK = ("plane-viscous-01", "plane-viscous-02", "stroller-waves-07", "stroller-waves-08")

#: What the package's own error may be beyond the bound: of event times [s] and of other quantities, relative.
ALLOWED = 1e-8
#: The same under exact Coulomb friction, where the package ends a slip at a speed of 1e-6 m/s or less.
ALLOWED_STICKING = 1e-6


def beyond(scene: dict, answer: dict) -> dict[str, float]:
    """Quantity -> error, for what is wrong by more than the bound and what is allowed."""
    allowed = ALLOWED_STICKING if scene.get("friction", {}).get("law") == "set-valued coulomb" else ALLOWED
    return {name: error for name, (error, bound) in check.errors(scene, answer).items() if error > bound + allowed}


def test_there_are_at_least_sixty_scenes_of_both_vehicles():
    assert len(SCENES) >= 60
    assert {scene["vehicle"] for scene in SCENES.values()} == {"top", "stroller"}
    assert all(scene["name"] == name for name, scene in SCENES.items())


def test_every_scene_keeps_to_the_schema():
    validator = jsonschema.Draft202012Validator(json.loads((ROOT / "schema.json").read_text()))
    assert {name: [error.message for error in validator.iter_errors(scene)] for name, scene in SCENES.items()} == {
        name: [] for name in SCENES
    }
    assert not validator.is_valid(SCENES[QUICK[0]] | {"outcome": "unknown"})


def test_bounds_are_far_below_the_values():
    """At most 1e-6 of the largest value, and 1e-6 s."""
    for scene in SCENES.values():
        quantities = [value for name, value in scene["states"].items() if name != "times"]
        assert all(quantity["bound"] < 1e-6 * np.max(np.abs(quantity["values"])) for quantity in quantities), scene[
            "name"
        ]
        assert all(event["bound"] < 1e-6 for event in scene["events"]), scene["name"]
        assert all(len(quantity["values"]) == len(scene["states"]["times"]) for quantity in quantities)


@pytest.mark.parametrize("name", QUICK)
def test_the_package_agrees_with_the_scene(name):
    """Within the bound and 1e-8; and the check sees an error of 1e-6."""
    scene = SCENES[name]
    answer = with_nonholonomic.simulate(scene)
    assert beyond(scene, answer) == {}
    assert len(answer["events"]) == len(scene["events"])
    wrong_states = answer["states"] | {"position": answer["states"]["position"] * (1.0 + 1e-6)}
    assert list(beyond(scene, answer | {"states": wrong_states})) == ["position"]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_the_package_agrees_with_every_scene(name):
    assert beyond(SCENES[name], with_nonholonomic.simulate(SCENES[name])) == {}


def test_the_scenes_are_what_their_program_computes():
    """The first ride, computed again by the program that wrote it."""
    scene = next(iter(generate.FAMILIES["strollers"]()))
    stored_scene = SCENES[scene["name"]]
    assert {name: scene[name] for name in ("body", "start", "damping", "source")} == {
        name: stored_scene[name] for name in ("body", "start", "damping", "source")
    }
    for name, quantity in scene["states"].items():
        if name != "times":
            assert_close(
                quantity["values"], stored_scene["states"][name]["values"], atol=stored_scene["states"][name]["bound"]
            )


def test_a_missing_event_has_an_infinite_error():
    scene = SCENES["plane-viscous-01"]
    assert check.errors(scene, {"events": []}) == {"inverted 1": (np.inf, scene["events"][0]["bound"])}
    assert check.errors(scene, {}) == {}
