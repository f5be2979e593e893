"""The unit that is not there: a motion, a unit with errors, and what its wire would carry.

    scenario   the YAML file: site, start, motion, unit, faults
    motion     motion -> exact integrals over every sample interval
    unit       integrals -> the unit's own errors -> pulses, with the truth beside them
    faults     what a bad line does to frames and messages

The truth is for tests and reports; nothing that estimates may see it.
"""
