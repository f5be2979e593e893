"""Simulator of a unit: motion, unit errors, wire encoding, line faults.

    scenario    YAML file: site, start, motion, unit, faults
    path        path of the body in one segment of motion, quadrature nodes
    integrate   path -> exact integrals over every sample interval
    unit        integrals -> pulses with the errors of the unit, and the truth
    truth       true unit as a calibration
    faults      faults of the line on frames and messages
    capture     pulses -> wire bytes or CAN messages, as a capture
    live        the same in real time
    links       the lines to play on: pty, serial port, TCP, CAN

The truth is for tests and reports; no estimator may use it.
"""
