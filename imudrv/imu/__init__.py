"""Frames to pulses to increments, pure: no I/O, no clock of its own, no settings files.

accounting     counter, losses, running totals: FRAME -> PULSES, and where every sample went
rate_filter    angular rate at the end of an interval from the increments around it
compensation   K, C, bias, temperature and the size effect: PULSES -> INCREMENTS
"""
