"""Script of the receiving process: `listener.py URL FILE` stores increments in a file until SIGTERM.

``FILE.times.npy`` has the host's time at which each of them came, ns since 1970.
"""

import signal
import sys
import threading
import time

import numpy as np

from imudrv.receiver import receive
from imudrv.records import INCREMENTS

if __name__ == "__main__":
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    received, times = [np.zeros(0, INCREMENTS)], [np.zeros(0, np.int64)]
    with receive(sys.argv[1], timeout_s=0.3) as receiver:
        print("listening", flush=True)
        is_last = False
        while not is_last:
            is_last = stop.is_set()  # what came in the last moment is taken as well
            for increments in receiver:
                times.append(np.full(len(increments), time.time_ns()))
                received.append(increments)
    np.save(sys.argv[2], np.concatenate(received))
    np.save(f"{sys.argv[2]}.times", np.concatenate(times))
    print(f"lost {receiver.counts.lost}, {receiver.rejected_bytes} bytes rejected")
