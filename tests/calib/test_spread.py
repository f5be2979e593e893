import math
import socket
from contextlib import suppress

import pytest

from calib.fleet.spread import spread
from imudrv.errors import InputError


def test_two_campaigns_on_one_computer_do_not_ask_for_the_same_port() -> None:
    pytest.importorskip("distributed")
    with socket.socket() as of_another_cluster:
        with suppress(OSError):  # there is one already
            of_another_cluster.bind(("127.0.0.1", 8787))
            of_another_cluster.listen()
        # A warning would be an error here.
        assert list(spread(math.sqrt, [4.0, 9.0, 2.0], workers=2)) == [2.0, 3.0, math.sqrt(2.0)]


def test_a_scheduler_that_does_not_answer_is_named() -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match=r"--scheduler inproc:nowhere: cannot connect"):
        list(spread(math.sqrt, [4.0], scheduler="inproc:nowhere"))
