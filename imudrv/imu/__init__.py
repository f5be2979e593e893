"""Frames to pulses to increments, pure: no I/O, no clock of its own, no settings files.

sequence       counter and losses: FRAME -> PULSES, and what became of every sample
conversion     contents of a frame: increments or running totals, temperatures, status
clock          host time of every sample
coefficients   a calibration in SI units
compensation   scale, misalignment, bias, temperature: PULSES -> INCREMENTS
rate_filter    angular rate at the end of an interval from the increments around it
size_effect    velocity that the accelerometers sense because they lie apart
"""
