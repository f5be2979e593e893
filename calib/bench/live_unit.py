"""Process of a simulated unit that is moved while it runs: one `Segment` as JSON a line on standard input.

It rests until a motion comes, and ends with its standard input.
"""

import os
import sys
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Final

from imudrv import profiles
from imudrv.sim import scenario as scenarios
from imudrv.sim.live import play
from imudrv.sim.scenario import OneMotion, Rest, Segment

PIECE_S: Final = 0.25
"""Length of a rest after which a motion may begin, s."""


def main(scenario: str, profile: str, target: str, link: str, speed: str) -> None:
    """Play a scenario, and then what standard input says.

    Parameters
    ----------
    scenario : str
        Path of the scenario.
    profile : str
        Wire format.
    target, link, speed : str
        See `imudrv.sim.live.play`; an empty link is none.
    """
    motions: SimpleQueue[OneMotion] = SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            for motion in Segment.model_validate_json(line).motions:
                motions.put(motion)
        os._exit(0)

    def more() -> OneMotion:
        try:
            return motions.get_nowait()
        except Empty:
            return Rest(duration_s=PIECE_S)

    Thread(target=read, daemon=True).start()
    started = scenarios.load(scenario)
    play(started, profiles.load(profile), target, float(speed), _say, link or None, more=more)


def _say(text: str) -> None:
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
