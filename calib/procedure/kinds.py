"""What the engine does differently for each kind of procedure."""

from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from calib.detection.rest_bins import LEAST_RESTS
from calib.messages import Message, message
from calib.procedure import rests, rotations
from calib.procedure.events import Phase
from calib.procedure.phases import PhaseState
from calib.procedure.plan import predicted
from calib.procedure.schema import Kind, Procedure
from calib.procedure.transitions import OF_RESTS, TRANSITIONS, Outcome
from imudrv.errors import InputError
from imudrv.site import Site


class KindOfProcedure(NamedTuple):
    """Phases of a kind of procedure and their order, and why a result is impossible without some steps."""

    transitions: Mapping[tuple[Phase, Outcome], Phase]
    states: Mapping[Phase, type[PhaseState]]
    too_few: Callable[[Procedure, Site, tuple[str, ...]], Message | None]


def _too_few_runs(procedure: Procedure, site: Site, skipped: tuple[str, ...]) -> Message | None:
    try:
        predicted(procedure, site, skipped=skipped)
    except InputError:
        return message("too_few_steps", steps=skipped)
    return None


def _too_few_rests(procedure: Procedure, site: Site, skipped: tuple[str, ...]) -> Message | None:
    least = LEAST_RESTS if procedure.kind == "sensors" else 1
    is_enough = len(procedure.steps) - len(skipped) >= least
    return None if is_enough else message("too_few_rests", steps=skipped)


KINDS: Final[Mapping[Kind, KindOfProcedure]] = {
    "arms": KindOfProcedure(TRANSITIONS, rotations.STATES, _too_few_runs),
    "sensors": KindOfProcedure(OF_RESTS, rests.OF_SENSORS, _too_few_rests),
    "noise": KindOfProcedure(OF_RESTS, rests.OF_NOISE, _too_few_rests),
}
