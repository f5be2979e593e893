"""Script of the receiving process: `listener.py URL FILE` stores increments in a file until SIGTERM."""

import signal
import sys
import threading

import numpy as np

from imudrv.receiver import receive
from imudrv.records import INCREMENTS

if __name__ == "__main__":
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    received = [np.zeros(0, INCREMENTS)]
    with receive(sys.argv[1], timeout_s=0.3) as receiver:
        print("listening", flush=True)
        while not stop.is_set():
            received.extend(receiver)
        received.extend(receiver)  # what came in the last moment
    np.save(sys.argv[2], np.concatenate(received))
    print(f"lost {receiver.counts.lost}, {receiver.rejected_bytes} bytes rejected")
