"""Diagnosis of a line, or of a capture, by the data in it; without I/O.

traffic    data decoded with a profile
mismatch   why data holds no frame of a profile, and which profile fits
sequence   why most good frames are not in sequence
line       state of an open line, watched arrival by arrival
"""

from imudrv.diagnosis.line import LineState, LineWatch
from imudrv.diagnosis.mismatch import Mismatch, best_profile, find_mismatch, fitting_profiles
from imudrv.diagnosis.sequence import sequence_fault
from imudrv.diagnosis.traffic import RATE_TOLERANCE, TrafficSummary, decode_traffic, explain, rate

__all__ = [
    "RATE_TOLERANCE",
    "LineState",
    "LineWatch",
    "Mismatch",
    "TrafficSummary",
    "best_profile",
    "decode_traffic",
    "explain",
    "find_mismatch",
    "fitting_profiles",
    "rate",
    "sequence_fault",
]
