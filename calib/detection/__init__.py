"""Rest and rotation in increments; one rule, offline and live.

blocks      blocks of 20 ms by the counter
noise       noise of the sensors from rests
segments    rests and rotations of a capture
sections    sections of a capture between restarts of the unit
tracking    the same online
acceptance  limits of a rotation and reasons for rejection
turns       runs: turns in one pose after one alignment
"""
