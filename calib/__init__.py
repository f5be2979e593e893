"""Finds where the accelerometers of the unit that `imudrv` drives sense: its inner lever arms.

The flow, one way; every module can be read alone::

    increments -> Segments -> Run, Run, ... -> Identification -> Arms
              segments    runs            identify           gauge

    segments   rest, rotation, orientation, found in the data; what cannot serve, with reasons
    runs       each rotation that serves: aligned, navigated, with its measurement matrices
    identify   `joint` (all that the rests tell), `plain` (the literature's V = H R), `predict` (before a run)
    gauge      where the origin is put, and how other programs count

    findings   captures to an identification, with all that a report wants to know
    certificate  the calibration that follows      report, plots, document  what people read

The bench procedure, with a technician::

    procedure  what is to be done, as data         rehearsal  a simulated technician who does it
    engine     the state machine: samples and keys in, events and a view out. motion is its senses, preflight
               its first look, prompts its words, events what it says
    console    the view on a terminal (letters: large ones)
    session    the evidence of a session: journal, recordings, result; resume and verify
    conduct    engine, session and screen together, beside the service      bench  `calib run`

And afterwards: `validate` judges compensation on a motion, `trials` makes the literature's four on simulated
units, `dither` says what dithering gyros do.

Increments are compensated for all but the size effect. The conventions are those of `imudrv`.
"""
