"""The transition table, and that the engine answers every action in every phase as the table says."""

from copy import deepcopy
from typing import Any

import numpy as np
import pytest

from calib.messages import verbatim
from calib.procedure.engine import Engine
from calib.procedure.events import Abort, Action, Confirm, Entered, Phase, Redo, Skip
from calib.procedure.rotations import STATES
from calib.procedure.schema import Procedure
from calib.procedure.transitions import TRANSITIONS, Outcome
from imudrv.files.settings_file import parse
from imudrv.records import INCREMENTS, Records
from imudrv.sim.scenario import NOMINAL
from imudrv.site import Site

PROCEDURE = parse(
    {
        "format": "imu50-procedure",
        "version": 1,
        "name": "test",
        "align_s": 30,
        "rest_s": 3,
        "limits": {"still_s": 1.0},
        "poses": [{"id": "z", "up": "+Z", "east": "+X", "turn_deg": 180}],
    },
    Procedure,
    "test",
)
ENDS = {Phase.DONE, Phase.ABORTED}
REQUESTS = {Outcome.AGAIN, Outcome.NEXT_STEP, Outcome.ABORTED}
ACTIONS: dict[Outcome, Action] = {
    Outcome.AGAIN: Redo("z"),
    Outcome.COMPLETED: Skip("z"),  # the only step
    Outcome.ABORTED: Abort(),
}


def reached(start: Phase, without: set[Outcome]) -> set[Phase]:
    """All phases to which rows lead from one, with some outcomes never happening."""
    phases, before = {start}, set[Phase]()
    while phases != before:
        before = set(phases)
        phases |= {
            to for (phase, outcome), to in TRANSITIONS.items() if phase in before and outcome not in without
        }
    return phases


def test_every_phase_has_a_class_and_is_reached_from_the_preflight() -> None:
    assert set(STATES) == set(Phase)
    assert reached(Phase.PREFLIGHT, set()) == set(Phase)


@pytest.mark.parametrize("phase", list(Phase))
def test_every_phase_reaches_an_end_by_the_sensors_and_by_the_operator(phase: Phase) -> None:
    assert reached(phase, REQUESTS) & ENDS
    assert phase in ENDS or TRANSITIONS[phase, Outcome.ABORTED] is Phase.ABORTED


def test_an_abort_is_final_and_every_outcome_is_used() -> None:
    assert not [phase for phase, _ in TRANSITIONS if phase is Phase.ABORTED]
    assert {outcome for _, outcome in TRANSITIONS} == set(Outcome)


@pytest.fixture(scope="module")
def engines(request: pytest.FixtureRequest) -> dict[Phase, Engine]:
    """An engine in each phase, as a step without a mistake leads through them."""
    bench: Any = request.getfixturevalue("bench")
    step: Any = request.getfixturevalue("step")
    samples: Records = bench(step(64.0), step(2.5, 180.0), step(12.0))
    site: Site = request.getfixturevalue("site")
    engine = Engine(PROCEDURE, site, NOMINAL, interval_ns=2_000_000, hands_free=True)
    engine.feed(samples[:0])  # that the preflight has begun
    found = {Phase.PREFLIGHT: deepcopy(engine)}
    for at in range(0, len(samples), 10):
        engine.feed(samples[at : at + 10])
        if engine.view.phase not in found:
            found[engine.view.phase] = deepcopy(engine)
    aborted = deepcopy(found[Phase.ALIGN])
    aborted.handle(Abort())
    return {**found, Phase.ABORTED: aborted}


@pytest.mark.parametrize("outcome", list(ACTIONS))
@pytest.mark.parametrize("phase", list(Phase))
def test_the_engine_follows_the_table_for_every_action_in_every_phase(
    phase: Phase, outcome: Outcome, engines: dict[Phase, Engine]
) -> None:
    expected = TRANSITIONS.get((phase, outcome), phase)
    has_just_begun = phase is Phase.PLACE and outcome is Outcome.AGAIN
    is_accepted = phase is Phase.VERDICT and outcome is Outcome.COMPLETED
    if has_just_begun or is_accepted:
        expected = phase
    engine = deepcopy(engines[phase])
    events = engine.handle(ACTIONS[outcome])

    assert engine.view.phase is expected
    assert [e.phase for e in events if isinstance(e, Entered)] == [expected] * (expected is not phase)
    assert bool(events) == (expected is not phase)


@pytest.mark.parametrize("phase", list(Phase))
def test_actions_for_other_steps_and_confirmations_at_the_wrong_time_change_nothing(
    phase: Phase, engines: dict[Phase, Engine]
) -> None:
    engine = deepcopy(engines[phase])
    before = engine.view
    others: list[Action] = [Confirm("x"), Skip("x"), Redo("x"), Redo("")]
    if phase is not Phase.PLACE:
        others.append(Confirm("z"))

    for action in others:
        assert engine.handle(action) == ()
    assert engine.feed(np.zeros(0, INCREMENTS)) == ()
    assert engine.view == before


@pytest.mark.parametrize("phase", list(Phase))
def test_every_phase_offers_the_keys_that_have_an_effect_and_no_others(
    phase: Phase, engines: dict[Phase, Engine]
) -> None:
    keys: dict[str, Action] = {
        "confirm": Confirm("z"),
        "redo": Redo("z"),
        "skip": Skip("z"),
        "abort": Abort(),
    }
    offered = engines[phase].view.actions

    effective = tuple(name for name, key in keys.items() if deepcopy(engines[phase]).handle(key))

    assert offered == effective


def test_a_step_without_a_complete_recording_is_repeated_in_every_phase_after_its_acceptance(
    engines: dict[Phase, Engine],
) -> None:
    for phase in (Phase.VERDICT, Phase.DONE):
        engine = deepcopy(engines[phase])
        engine.reject("z", verbatim("the disk is full"))
        assert engine.view.phase is TRANSITIONS[phase, Outcome.REJECTED]
        assert engine.accepted == {}
