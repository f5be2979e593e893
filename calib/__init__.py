"""Finds where the accelerometers of the unit that `imudrv` drives sense: its inner lever arms.

The flow, one way; every module can be read alone::

    increments -> Segments -> Run, Run, ... -> Identification -> Arms
              segments    runs            identify           gauge

    segments   rest, rotation, orientation, found in the data; what cannot serve, with reasons
    runs       each rotation that serves: aligned, navigated, with its measurement matrices
    identify   `joint` (all that the rests tell), `plain` (the literature's V = H R), `predict` (before a run)
    gauge      where the origin is put, and how other programs count

Increments are compensated for all but the size effect. The conventions are those of `imudrv`.
"""
